"""Rows in a ring: the newest ``capacity`` are live, and know which row follows in their episode.

Rows are numbered from the first ever inserted and never renumbered; row ``r`` lies in slot
``r % size``. The ring has more slots than live rows, so that what is being written, or may have to
be taken back, never lies over a row that is live.
"""

from dataclasses import dataclass

import numpy as np

from a2s.learner.replay.columns import Columns
from a2s.learner.replay.record import CONTINUES, STARTS, TERMINATED, TRUNCATED, Numbers, Record
from a2s.learner.replay.transitions import Rows
from a2s.protocol.messages import Segment

_LONGEST_PIECE = 4096
_FEW_STREAMS = 1024


def longest_piece(capacity: int) -> int:
    """Rows that are written at once at most."""
    return min(_LONGEST_PIECE, capacity)


def num_slots(capacity: int) -> int:
    """Rows in the file: one piece being written, one taken back, one partly evicted."""
    return capacity + 3 * longest_piece(capacity)


@dataclass(slots=True)
class _Tail:
    """Where the latest episode of a stream stands: its last row, and its length so far."""

    row: int
    episode_length: int


class Ring:
    """The rows of a replay, and the links between them.

    Args:
        capacity: Rows that are live at most.
        slots: Where they lie, ``num_slots(capacity)`` of them.
    """

    def __init__(self, capacity: int, slots: Columns) -> None:
        self.capacity = capacity
        self.slots = slots
        self.begin = 0
        self.end = 0
        self._distance = np.zeros(len(slots), np.int32)  # rows to the next step of the episode
        self._tails: dict[tuple[str, int], _Tail] = {}
        self._most_tails = _FEW_STREAMS

    def __len__(self) -> int:
        return self.end - self.begin

    def write(self, segment: Segment, begin: int) -> Record:
        """Write the steps of a segment from ``begin`` on, as many as fit; they are not yet live.

        Returns:
            Their record, without checksum.
        """
        end = min(segment.num_steps, begin + self.room)
        is_last = end == segment.num_steps
        slots, first = self.slots, self.end % len(self.slots)
        last = first + end - begin - 1
        slots.obs[first : last + 1] = segment.obs[begin:end]
        slots.action[first : last + 1] = segment.suggestion[begin:end]
        slots.next_obs[first:last] = segment.obs[begin + 1 : end]
        slots.next_obs[last] = segment.final_obs if is_last else segment.obs[end]
        slots.outcome[first : last + 1, 0] = segment.reward[begin:end]
        slots.outcome[first : last + 1, 1] = 1.0
        flags = STARTS if begin == 0 and segment.episode_length == segment.num_steps else 0
        if is_last:
            flags |= TERMINATED * segment.terminated | TRUNCATED * segment.truncated
            slots.outcome[last, 1] = not segment.terminated
        else:
            flags |= CONTINUES
        return Record(
            row=self.end,
            previous=self.end - 1 if begin else self._previous(segment),
            seq=segment.seq,
            episode_length=segment.episode_length - segment.num_steps + end,
            env=segment.env,
            steps=end - begin,
            flags=flags,
            rows_hash=0,
            actor=segment.actor,
        )

    def admit(self, record: Record) -> None:
        """Make written rows live, link them, and evict the oldest beyond the capacity."""
        slot = record.row % len(self.slots)
        last = slot + record.steps - 1
        self._distance[slot:last] = 1
        self._distance[last] = 0
        if record.previous >= self.begin:
            self._distance[record.previous % len(self.slots)] = record.row - record.previous
        self.end = record.end
        self.begin = max(self.begin, self.end - self.capacity)
        self._remember(record)

    def restore(self, numbers: Numbers, live: list[Record], end: int) -> None:
        """Take up rows that lie there already, of successive records.

        Args:
            numbers: All that is in them but the names.
            live: Those records of which a row is live.
            end: Number of the row that comes next.
        """
        self.begin = self.end = end
        if not len(numbers):
            return
        self.begin = max(int(numbers["row"][0]), end - self.capacity)
        size = len(self.slots)
        self._distance[np.arange(self.begin, self.end) % size] = 1
        last = numbers["row"] + numbers["steps"] - 1
        self._distance[last[last >= self.begin] % size] = 0
        linked = numbers[numbers["previous"] >= self.begin]
        self._distance[linked["previous"] % size] = linked["row"] - linked["previous"]
        for record in live:
            self._remember(record)

    def follow(self, row: Rows) -> Rows:
        """Find the next step of the same episode, ``[B]``; the row itself where none is known.

        What follows is always newer, so what follows a live row is live.
        """
        return row + self._distance.take(row % len(self.slots))

    def slot(self, row: Rows) -> Rows:
        """Find where rows lie, ``[B]``."""
        return row % len(self.slots)

    @property
    def room(self) -> int:
        """Rows that can be written next in one stretch."""
        return min(longest_piece(self.capacity), len(self.slots) - self.end % len(self.slots))

    def stretch(self, row: int, count: int) -> Columns:
        """Look at successive rows that were written in one stretch."""
        return self.slots.stretch(row % len(self.slots), count)

    def _previous(self, segment: Segment) -> int:
        """Find the row of the step before a segment; only the very same observation will do.

        The length alone is not enough: of two episodes with segments lost between them, one may
        seem to go on where the other was left.
        """
        tail = self._tails.get((segment.actor, segment.env))
        before = segment.episode_length - segment.num_steps
        if tail is None or tail.episode_length != before:
            return -1
        seen = self.slots.next_obs[tail.row % len(self.slots)]
        return tail.row if np.array_equal(seen, segment.obs[0]) else -1

    def _remember(self, record: Record) -> None:
        stream = (record.actor, record.env)
        if record.flags & (TERMINATED | TRUNCATED):
            self._tails.pop(stream, None)
            return
        self._tails[stream] = _Tail(record.end - 1, record.episode_length)
        if len(self._tails) > self._most_tails:
            self._tails = {k: t for k, t in self._tails.items() if t.row >= self.begin}
            self._most_tails = max(_FEW_STREAMS, 2 * len(self._tails))
