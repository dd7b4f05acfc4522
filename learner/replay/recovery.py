"""Opening a replay after a kill: torn and unacknowledged records at its end are cut."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from a2s.learner.replay.files import Description, Files
from a2s.learner.replay.index import CONTINUES, RECORD_BYTES, Record, is_whole, numbers, unpack
from a2s.learner.replay.ring import Ring, max_piece
from a2s.protocol.errors import RunDirectoryError


class Recovery:
    """Finds the rows that count, compares each with its checksum and makes them live.

    Args:
        path: The directory.
        about: What is in it.
        writable: Open the files for writing; nothing is written here.
        is_known: Whether the segment with this actor and number is in the ledger. Unknown ones at
            the end were not acknowledged, and are taken back.

    Attributes:
        files: The open files.
        ring: The rows.
        live: Records with a live row, oldest first.
        num_bytes: Bytes of the file that count.
        torn: Records cut because a kill had torn them or their rows.
        taken_back: Rows cut because the ledger does not know their segment.

    Raises:
        RunDirectoryError: A file cannot be read, or something else than the end is damaged.
    """

    def __init__(
        self,
        path: Path,
        about: Description,
        *,
        writable: bool = False,
        is_known: Callable[[str, int], bool] | None = None,
    ) -> None:
        self._path = path
        self.files = Files(path, about, writable=writable)
        self.ring = Ring(about.capacity, self.files.slots)
        self._data, self._end = self._read()
        self.torn = -(-len(self._data) // RECORD_BYTES) - self._end
        written = self._next_row
        self.torn += self._cut(_is_unfinished)[0]
        self.taken_back = 0
        if is_known is not None:
            self.taken_back = self._cut(lambda record: not is_known(record.actor, record.seq))[1]
        self.torn += self._cut(lambda record: not self._has_rows_of(record))[0]
        self.torn += self._cut(_is_unfinished)[0]
        self.num_bytes = self._end * RECORD_BYTES
        self.live: list[Record] = []
        self._make_live(written)

    def _read(self) -> tuple[bytes, int]:
        """Read the file, and count its records up to a torn end."""
        try:
            data = self.files.index_path.read_bytes()
        except OSError as error:
            raise RunDirectoryError(f"{self.files.index_path}: {error.strerror}") from None
        whole = [is_whole(memoryview(data), i) for i in range(len(data) // RECORD_BYTES)]
        while whole and not whole[-1]:
            whole.pop()
        if not all(whole):
            raise self._damaged(f"the checksum of record {whole.index(False)} does not match")
        found = numbers(data)[: len(whole)]
        gap = (found["row"] + found["steps"])[:-1] != found["row"][1:]
        if gap.any():
            raise self._damaged(f"record {int(gap.argmax()) + 1} does not follow the one before")
        return data, len(whole)

    @property
    def _next_row(self) -> int:
        return unpack(self._data, self._end - 1).end if self._end else 0

    def _cut(self, is_bad: Callable[[Record], bool]) -> tuple[int, int]:
        """Cut bad records from the end, and count them and their rows."""
        records = rows = 0
        while self._end and is_bad(record := unpack(self._data, self._end - 1)):
            self._end -= 1
            records, rows = records + 1, rows + record.steps
        return records, rows

    def _make_live(self, written: int) -> None:
        """Make live what is left, of the rows below ``written``."""
        capacity = self.ring.capacity
        found = numbers(self._data)[: self._end]
        # What was cut lies over the oldest rows, if it was much; a piece may have come after it.
        reach = written - capacity - 2 * max_piece(capacity)
        overwritten = int(np.count_nonzero(found["row"] < reach))
        ends = found["row"] + found["steps"]
        evicted = int(ends.searchsorted(self._next_row - capacity, side="right"))
        for i in range(max(overwritten, evicted), self._end):
            record = unpack(self._data, i)
            if not self._has_rows_of(record):
                raise self._damaged(f"the checksum of the rows from {record.row} does not match")
            self.live.append(record)
        self.ring.restore(found[overwritten:], self.live, self._next_row)

    def _has_rows_of(self, record: Record) -> bool:
        return self.ring.stretch(record.row, record.steps).checksum() == record.rows_hash

    def _damaged(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(
            f"replay {self._path}: {what}; move the directory away to begin another"
        )


def _is_unfinished(record: Record) -> bool:
    return bool(record.flags & CONTINUES)
