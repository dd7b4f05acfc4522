"""A replay in a directory: made, opened, given another capacity, or looked at."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np

from a2s.learner.replay.files import NAME, RESTORE, Description, Files, describe, locked
from a2s.learner.replay.index import CONTINUES, STARTS, TERMINATED, TRUNCATED, Index, Record
from a2s.learner.replay.repair import Repair
from a2s.learner.replay.replay import Replay
from a2s.learner.replay.ring import Ring
from a2s.learner.replay.sampling import Priorities
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.fields import Spaces


def find(path: Path) -> Path:
    """Find the replay of a run directory, or take the path itself for one."""
    inside = path / "replay"
    return inside if (inside / NAME).exists() else path


def create(
    path: Path,
    env_id: str,
    spaces: Spaces,
    capacity: int,
    *,
    batch_size: int = 1,
    alpha: float = 0.6,
    source: str = "",
) -> Replay:
    """Make a replay; its room on the disk is taken now.

    It keeps the newest ``capacity`` transitions, which must be enough for the largest batch;
    ``alpha`` is the exponent of the priorities, ``source`` where the transitions come from, if not
    from a run of its own.

    Raises:
        UsageError: The capacity is below one batch.
        RunDirectoryError: A replay exists already, or room or permission is missing.
    """
    _require_capacity(capacity, batch_size)
    about = Description(env_id=env_id, spaces=spaces, capacity=capacity, files=1, source=source)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"replay {path}: {error.strerror}") from None
    with locked(path) as lock_file:
        _require_empty(path)
        files = Files(path, about, writable=True, new=True)
        files.index = Index(files.index_path, 0)
        about.write(path)
        files.lock_file = lock_file
        ring = Ring(capacity, files.slots)
        return Replay(about, ring, Priorities(ring, files.priority, alpha), files)


def open_existing(
    path: Path,
    *,
    env_id: str | None = None,
    spaces: Spaces | None = None,
    capacity: int | None = None,
    batch_size: int = 1,
    is_known: Callable[[str, int], bool] | None = None,
    least_rows: int = 0,
    most_rows: int | None = None,
    alpha: float = 0.6,
) -> Replay:
    """Open a replay to go on with it; every live row is compared with its checksum.

    With another ``capacity`` the newest rows are kept. Segments that ``is_known`` does not find in
    the ledger are taken back, see `Repair`. The first ``least_rows`` were inserted before the
    newest checkpoint: a kill cannot tear them, so that a replay without them is damaged. Those past
    ``most_rows`` are taken back: they are inserted again.

    Raises:
        UsageError: The capacity is below one batch.
        RunDirectoryError: The replay is missing, damaged, of another environment or in use, or
            there is no room for another capacity; nothing was destroyed.
    """
    about = describe(path)
    if env_id is not None and spaces is not None:
        about.require(path, env_id, spaces)
    capacity = about.capacity if capacity is None else capacity
    _require_capacity(capacity, batch_size)
    with locked(path) as lock_file:
        found = Repair(path, about, writable=True, is_known=is_known, most_rows=most_rows)
        files, ring = found.files, found.ring
        if ring.end < least_rows:
            unknown = found.taken_back
            short = f"segments.log does not know {unknown} more; " if unknown else ""
            raise RunDirectoryError(
                f"replay {path}: found {ring.end} transitions that are whole and in the "
                f"ledger, expected at least the {least_rows} of the newest checkpoint; "
                f"{short}{RESTORE}"
            )
        if capacity == about.capacity:
            files.index = Index(files.index_path, found.num_bytes)
        else:
            about = replace(about, capacity=capacity, files=about.files + 1)
            files, ring = _resize(path, about, found)
        files.lock_file = lock_file
        priorities = Priorities(ring, files.priority, alpha)
        return Replay(
            about,
            ring,
            priorities,
            files,
            torn_records=found.torn,
            taken_back=found.taken_back,
        )


def look_at(path: Path, *, alpha: float = 0.6, alone: bool = False) -> Replay:
    """Open a replay to read it, also while a learner writes to it: its present state is seen.

    Nothing in the directory is changed. Later insertions of the learner are not seen, but
    overwrite the oldest rows: to read for long, ask to be ``alone``, which refuses a replay that a
    learner writes to, and keeps learners out until it is closed.

    Raises:
        RunDirectoryError: The replay is missing or damaged, or a learner writes to it.
    """
    about = describe(path)
    with locked(path, to_read=True) if alone else nullcontext(-1) as lock_file:
        found = Repair(path, about)
        found.files.lock_file = lock_file
        priorities = Priorities(found.ring, found.files.priority.copy(), alpha)
        return Replay(about, found.ring, priorities, found.files, torn_records=found.torn)


def _resize(path: Path, about: Description, found: Repair) -> tuple[Files, Ring]:
    """Copy the newest rows into files of another capacity; they keep their numbers and links."""
    files = Files(path, about, writable=True, new=True)
    source, target = found.ring, Ring(about.capacity, files.slots)
    target.begin = target.end = max(source.begin, source.end - target.capacity)
    packed = []
    for record in found.live:
        while target.end < record.end:
            piece = _next_piece(record, target)
            rows = target.stretch(piece.row, piece.steps)
            for new, old in zip(rows, source.stretch(piece.row, piece.steps), strict=True):
                new[:] = old
            piece = piece._replace(rows_hash=rows.checksum())
            target.admit(piece)
            packed.append(piece.pack())
    row = np.arange(target.begin, target.end)
    files.priority[target.slot(row)] = found.files.priority[source.slot(row)]
    files.index = Index(files.index_path, 0)
    files.index.append(b"".join(packed), target.begin)
    files.flush()
    about.write(path)  # from here on the new files count
    found.files.delete()
    return files, target


def _next_piece(record: Record, target: Ring) -> Record:
    """Cut the next part of a record that fits in one stretch."""
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


def _require_empty(path: Path) -> None:
    if (path / NAME).exists():
        raise RunDirectoryError(f"replay {path}: is there already; resume, or name another run")
    for index in path.glob("index-*.log"):
        if index.stat().st_size:  # one that a kill left while it was made is empty
            raise RunDirectoryError(
                f"replay {path}: found transitions in {index.name}, but no {NAME}; {RESTORE}"
            )


def _require_capacity(capacity: int, batch_size: int) -> None:
    if capacity < batch_size:
        raise UsageError(
            f"replay capacity: found {capacity}, expected at least one batch of {batch_size}"
        )
