"""Rows in a ring: the newest ``capacity`` are live, and know which row follows in their episode.

Rows are numbered from the first ever inserted and never renumbered; row ``r`` lies in slot
``r % size``. The ring has more slots than live rows, so that what is being written, or may have to
be taken back, never lies over a row that is live.
"""

from dataclasses import dataclass

import numpy as np

from a2s.learner.replay.layout import Layout
from a2s.learner.replay.record import CONTINUES, STARTS, TERMINATED, TRUNCATED, Columns, Record
from a2s.learner.replay.transitions import Rows
from a2s.protocol.messages import Array, Segment

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
        layout: Of a row.
        capacity: Rows that are live at most.
        rows: Where they lie, float32 ``[num_slots(capacity), layout.width]``.
    """

    def __init__(self, layout: Layout, capacity: int, rows: Array) -> None:
        self.layout = layout
        self.capacity = capacity
        self.rows = rows
        self.begin = 0
        self.end = 0
        self._successor: Rows = np.full(len(rows), -1, np.int64)
        self._tails: dict[tuple[str, int], _Tail] = {}
        self._most_tails = _FEW_STREAMS

    def __len__(self) -> int:
        return self.end - self.begin

    def write(self, segment: Segment, begin: int) -> tuple[Record, memoryview]:
        """Write the steps of a segment from ``begin`` on, as many as fit; they are not yet live.

        Returns:
            Their record, without checksum, and their bytes.
        """
        slot = self.end % len(self.rows)
        room = min(longest_piece(self.capacity), len(self.rows) - slot)
        end = min(segment.num_steps, begin + room)
        is_last = end == segment.num_steps
        rows, layout = self.rows[slot : slot + end - begin], self.layout
        layout.obs(rows)[:] = segment.obs[begin:end]
        layout.action(rows)[:] = segment.suggestion[begin:end]
        layout.reward(rows)[:] = segment.reward[begin:end]
        layout.next_obs(rows)[:-1] = segment.obs[begin + 1 : end]
        layout.next_obs(rows)[-1] = segment.final_obs if is_last else segment.obs[end]
        layout.terminated(rows)[:] = 0.0
        layout.truncated(rows)[:] = 0.0
        flags = STARTS if begin == 0 and segment.episode_length == segment.num_steps else 0
        if is_last:
            rows[-1, -2:] = segment.terminated, segment.truncated
            flags |= TERMINATED * segment.terminated | TRUNCATED * segment.truncated
        else:
            flags |= CONTINUES
        record = Record(
            row=self.end,
            previous=self.end - 1 if begin else self._previous(segment),
            seq=segment.seq,
            episode_length=segment.episode_length - segment.num_steps + end,
            env=segment.env,
            steps=end - begin,
            flags=flags,
            rows_crc=0,
            actor=segment.actor,
        )
        return record, rows.data.cast("B")

    def admit(self, record: Record) -> None:
        """Make written rows live, link them, and evict the oldest beyond the capacity."""
        slot = record.row % len(self.rows)
        numbers = np.arange(record.row + 1, record.end + 1)
        self._successor[slot : slot + record.steps] = numbers
        self._successor[slot + record.steps - 1] = -1
        if record.previous >= self.begin:
            self._successor[record.previous % len(self.rows)] = record.row
        self.end = record.end
        self.begin = max(self.begin, self.end - self.capacity)
        self._remember(record)

    def restore(self, columns: Columns, live: list[Record]) -> None:
        """Take up rows that lie there already, of successive records.

        Args:
            columns: All their numbers.
            live: Those records of which a row is live.
        """
        if not len(columns):
            return
        self.end = int(columns["row"][-1] + columns["steps"][-1])
        self.begin = max(int(columns["row"][0]), self.end - self.capacity)
        size = len(self.rows)
        numbers = np.arange(self.begin, self.end)
        self._successor[numbers % size] = numbers + 1
        last = columns["row"] + columns["steps"] - 1
        self._successor[last[last >= self.begin] % size] = -1
        linked = columns[columns["previous"] >= self.begin]
        self._successor[linked["previous"] % size] = linked["row"]
        for record in live:
            self._remember(record)

    def follow(self, row: Rows) -> Rows:
        """Find the next step of the same episode, ``[B]``; -1 where it ended or none is known.

        A row's successor is always newer, so a live row's is live.
        """
        return self._successor.take(row % len(self.rows))

    def take(self, row: Rows) -> Array:
        """Copy live rows, ``[B]`` to ``[B, layout.width]``."""
        return self.rows.take(row % len(self.rows), axis=0)

    def reward(self, row: Rows) -> Array:
        """Copy the rewards of live rows, ``[B]``."""
        return self.layout.reward(self.rows)[row % len(self.rows)]

    def stretch(self, begin: int, end: int) -> Array:
        """Look at rows that one record holds."""
        slot = begin % len(self.rows)
        return self.rows[slot : slot + end - begin]

    def _previous(self, segment: Segment) -> int:
        """Find the row of the step before a segment; only the very same observation will do.

        The length alone is not enough: of two episodes with segments lost between them, one may
        seem to go on where the other was left.
        """
        tail = self._tails.get((segment.actor, segment.env))
        before = segment.episode_length - segment.num_steps
        if tail is None or tail.row < self.begin or tail.episode_length != before:
            return -1
        seen = self.layout.next_obs(self.rows[tail.row % len(self.rows)])
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
