"""Opening a replay after a kill: torn and unacknowledged records at its end are cut."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from a2s.learner.replay.files import RESTORE, Description, Files
from a2s.learner.replay.index import CONTINUES, RECORD_BYTES, Record, unpack
from a2s.learner.replay.ring import Ring, max_piece
from a2s.protocol.errors import RunDirectoryError


class Repair:
    """Finds the rows that count, compares each with its checksum and makes them live in ``ring``.

    ``is_known`` says whether the segment with this actor and number is in the ledger. Unknown ones
    at the end were not acknowledged, and are taken back; so are those past ``most_rows``. Nothing
    is written to the files here.

    Attributes:
        live: Records with a live row, oldest first.
        num_bytes: Bytes of the index that count.
        torn: Records cut because a kill had torn them or their rows.
        taken_back: Rows cut because the ledger does not know their segment.

    Raises:
        RunDirectoryError: A file cannot be read, or is damaged elsewhere than at the end.
    """

    def __init__(
        self,
        path: Path,
        about: Description,
        *,
        writable: bool = False,
        is_known: Callable[[str, int], bool] | None = None,
        most_rows: int | None = None,
    ) -> None:
        self._path = path
        self.files = Files(path, about, writable=writable)
        self.ring = Ring(about.capacity, self.files.slots)
        self._records, self.torn = self._read()
        written = self._next_row
        self.torn += len(self._cut(_is_unfinished))
        self.taken_back = 0
        if is_known is not None:
            unknown = self._cut(lambda record: not is_known(record.actor, record.seq))
            self.taken_back = sum(record.steps for record in unknown)
        self.torn += len(self._cut(lambda record: not self._has_rows_of(record)))
        self.torn += len(self._cut(_is_unfinished))
        if most_rows is not None:
            self._cut(lambda record: record.end > most_rows)
        self.num_bytes = len(self._records) * RECORD_BYTES
        self.live = self._make_live(written)

    def _read(self) -> tuple[list[Record], int]:
        """Read the index: its records up to a torn end, and how many are torn."""
        path = self.files.index_path
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RunDirectoryError(f"{path}: {error.strerror}; {RESTORE}") from None
        found = [unpack(data, i) for i in range(len(data) // RECORD_BYTES)]
        while found and found[-1] is None:
            found.pop()
        records = [record for record in found if record is not None]
        if len(records) < len(found):
            raise self._damaged(f"the checksum of record {found.index(None)} does not match")
        for i, (before, record) in enumerate(pairwise(records), 1):
            if before.end != record.row:
                raise self._damaged(f"record {i} does not follow the one before")
        return records, -(-len(data) // RECORD_BYTES) - len(records)

    @property
    def _next_row(self) -> int:
        return self._records[-1].end if self._records else 0

    def _cut(self, is_bad: Callable[[Record], bool]) -> list[Record]:
        cut = []
        while self._records and is_bad(self._records[-1]):
            cut.append(self._records.pop())
        return cut

    def _make_live(self, written: int) -> list[Record]:
        """Make the newest rows live; those below ``written`` had been, before the cut."""
        records, ring, next_row = self._records, self.ring, self._next_row
        # A large cut part lies over the oldest rows; a piece may have come after it.
        reach = written - ring.capacity - 2 * max_piece(ring.capacity)
        first = bisect_left(records, reach, key=lambda record: record.row)
        oldest = records[first].row if first < len(records) else next_row
        ring.begin, ring.end = max(oldest, next_row - ring.capacity), next_row
        live = records[bisect_right(records, ring.begin, key=lambda record: record.end) :]
        for record in live:
            if not self._has_rows_of(record):
                raise self._damaged(f"the checksum of the rows from {record.row} does not match")
            ring.admit(record)
        return live

    def _has_rows_of(self, record: Record) -> bool:
        return self.ring.stretch(record.row, record.steps).checksum() == record.rows_hash

    def _damaged(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(f"replay {self._path}: {what}; {RESTORE}")


def _is_unfinished(record: Record) -> bool:
    return bool(record.flags & CONTINUES)
