"""Reading an index: which rows count after whatever has happened to the learner."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from a2s.learner.replay.record import (
    CONTINUES,
    RECORD_BYTES,
    Numbers,
    Record,
    is_whole,
    numbers,
    unpack,
)
from a2s.learner.replay.ring import longest_piece
from a2s.protocol.errors import RunDirectoryError


class Records:
    """The records of a replay, oldest first.

    Args:
        path: The file of the index.

    Attributes:
        torn: Records that a kill had torn, not counted among the rest.
        taken_back: Rows of the records that were cut because they are not known elsewhere.

    Raises:
        RunDirectoryError: The file cannot be read, or a record is damaged and not merely torn.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RunDirectoryError(f"{path}: {error.strerror}") from None
        whole = [is_whole(memoryview(data), i) for i in range(len(data) // RECORD_BYTES)]
        while whole and not whole[-1]:
            whole.pop()
        if not all(whole):
            raise self._damaged(f"the checksum of record {whole.index(False)} does not match")
        self._data = data
        self._begin, self._end = 0, len(whole)
        found = self.numbers
        gap = (found["row"] + found["steps"])[:-1] != found["row"][1:]
        if gap.any():
            raise self._damaged(f"record {int(gap.argmax()) + 1} does not follow the one before")
        self.torn = -(-len(data) // RECORD_BYTES) - self._end
        self.taken_back = 0
        self._written = self.next_row
        self._cut_unfinished()

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def numbers(self) -> Numbers:
        """All that is in the records but the names."""
        return numbers(self._data[self._begin * RECORD_BYTES : self._end * RECORD_BYTES])

    @property
    def next_row(self) -> int:
        """Number of the row that comes next."""
        return self._last.end if self._end else 0

    @property
    def num_bytes(self) -> int:
        """The part of the file that counts."""
        return self._end * RECORD_BYTES

    def cut(self, is_known: Callable[[str, int], bool]) -> None:
        """Take back the segments at the end that were not written down elsewhere.

        Args:
            is_known: Whether the segment with this actor and number was.
        """
        while len(self) and not is_known(self._last.actor, self._last.seq):
            self.taken_back += self._last.steps
            self._end -= 1

    def verify(self, capacity: int, checksum: Callable[[Record], int]) -> list[Record]:
        """Compare the live rows with their checksums; torn ones at the end are cut.

        Args:
            capacity: Of the replay.
            checksum: Computes that of the rows of a record.

        Returns:
            The records of which a row is among the newest ``capacity``.

        Raises:
            RunDirectoryError: Rows are damaged, and newer ones are not.
        """
        if not len(self):
            return []
        while len(self) and checksum(self._last) != self._last.rows_hash:
            self._end -= 1
            self.torn += 1
        self._cut_unfinished()
        # What was cut lies over the oldest rows, if it was much; a piece may have come after it.
        reach = self._written - capacity - 2 * longest_piece(capacity)
        self._begin += int(np.count_nonzero(self.numbers["row"] < reach))
        live = self._live(capacity)
        for record in live:
            if checksum(record) != record.rows_hash:
                raise self._damaged(f"the checksum of the rows from {record.row} does not match")
        return live

    def _live(self, capacity: int) -> list[Record]:
        if not len(self):
            return []
        ends = self.numbers["row"] + self.numbers["steps"]
        first = int(ends.searchsorted(ends[-1] - capacity, side="right"))
        return [unpack(self._data, i) for i in range(self._begin + first, self._end)]

    @property
    def _last(self) -> Record:
        return unpack(self._data, self._end - 1)

    def _cut_unfinished(self) -> None:
        while len(self) and self._last.flags & CONTINUES:
            self._end -= 1
            self.torn += 1

    def _damaged(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(
            f"replay {self.path.parent}: {what}; move the directory away to begin another"
        )
