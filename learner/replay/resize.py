"""Copying the newest rows of a replay into one of another capacity."""

from a2s.learner.replay.record import CONTINUES, STARTS, TERMINATED, TRUNCATED, Record
from a2s.learner.replay.ring import Ring


def copy_newest(source: Ring, records: list[Record], target: Ring) -> bytes:
    """Copy as many of the newest rows as the target takes; they keep their numbers and links.

    Args:
        source: The ring with the rows.
        records: Of the rows that are live there.
        target: An empty ring.

    Returns:
        The packed records of the target.
    """
    target.begin = target.end = max(source.begin, source.end - target.capacity)
    packed = []
    for record in records:
        while target.end < record.end:
            piece = _piece(record, target)
            rows = target.stretch(piece.row, piece.steps)
            rows.copy(source.stretch(piece.row, piece.steps))
            piece = piece._replace(rows_hash=rows.checksum())
            target.admit(piece)
            packed.append(piece.pack())
    return b"".join(packed)


def _piece(record: Record, target: Ring) -> Record:
    """Cut from a record what comes next and fits in one stretch."""
    row = target.end
    end = min(record.end, row + target.room)
    flags = record.flags
    previous = record.previous
    if row > record.row:
        flags &= ~STARTS
        previous = row - 1
    if end < record.end:
        flags = flags & ~(TERMINATED | TRUNCATED) | CONTINUES
    return record._replace(
        row=row,
        previous=previous if previous >= target.begin else -1,
        episode_length=record.episode_length - (record.end - end),
        steps=end - row,
        flags=flags,
    )
