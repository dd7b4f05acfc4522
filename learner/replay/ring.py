"""Rows in a ring: the newest ``capacity`` are live, and know which row follows in their episode.

Rows are numbered from the first ever inserted and never renumbered; row ``r`` lies in slot
``r % size``. The ring has more slots than live rows, so that what is being written, or may have to
be taken back, never lies over a row that is live.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xxhash

from a2s.learner.replay.index import CONTINUES, STARTS, TERMINATED, TRUNCATED, Record
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import Segment

Rows = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

_MAX_PIECE = 4096
_MIN_TAILS = 1024


def max_piece(capacity: int) -> int:
    """Rows that are written at once at most."""
    return min(_MAX_PIECE, capacity)


class Columns(NamedTuple):
    """Transitions in S slots, all float32 and contiguous.

    Attributes:
        obs: Observation before the step, ``[S, D]``.
        action: Executed suggestion, ``[S, A]``.
        next_obs: Observation after the step, of the same episode, ``[S, D]``.
        outcome: Reward, and 0 where the step terminated the episode, else 1, ``[S, 2]``.
    """

    obs: Array
    action: Array
    next_obs: Array
    outcome: Array

    def checksum(self) -> int:
        """XXH3, 64 bits, of all bytes, column by column."""
        digest = xxhash.xxh3_64()
        for column in self:
            digest.update(column.data.cast("B"))
        return digest.intdigest()


def make_columns(
    spaces: Spaces, capacity: int, make: Callable[[str, tuple[int, int]], Array]
) -> Columns:
    """Make the columns of a ring, each by its name and shape.

    There is room for the live rows, one piece being written, one taken back, one partly evicted.
    """
    size = capacity + 3 * max_piece(capacity)
    obs_size, action_size = spaces.obs_size, spaces.action_size
    widths = {"obs": obs_size, "action": action_size, "next_obs": obs_size, "outcome": 2}
    return Columns(**{name: make(name, (size, width)) for name, width in widths.items()})


class Ring:
    """The rows of a replay, ``begin`` to below ``end``, and the links between them."""

    def __init__(self, capacity: int, slots: Columns) -> None:
        self.capacity = capacity
        self.slots = slots
        self.size = len(slots.outcome)
        self.begin = 0
        self.end = 0
        self._distance = np.zeros(self.size, np.int32)  # rows to the next step of the episode
        self._tails: dict[tuple[str, int], Record] = {}  # newest of each actor and environment
        self._max_tails = _MIN_TAILS

    def __len__(self) -> int:
        return self.end - self.begin

    def write(self, segment: Segment, begin: int) -> Record:
        """Write the steps of a segment from ``begin`` on, as many as fit; they are not yet live."""
        end = min(segment.num_steps, begin + self.room)
        is_last = end == segment.num_steps
        slots, first = self.slots, self.end % self.size
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
        slot = record.row % self.size
        last = slot + record.steps - 1
        self._distance[slot:last] = 1
        self._distance[last] = 0
        if record.previous >= self.begin:
            self._distance[record.previous % self.size] = record.row - record.previous
        self.end = record.end
        self.begin = max(self.begin, self.end - self.capacity)
        self._remember(record)

    def follow(self, row: Rows) -> Rows:
        """Find the next step of the same episode, ``[B]``; the row itself if it is not known.

        The next step is always newer, so that of a live row is live.
        """
        return row + self._distance.take(row % self.size)

    def slot(self, row: Rows) -> Rows:
        """Find where rows lie, ``[B]``."""
        return row % self.size

    @property
    def room(self) -> int:
        """Rows that can be written next in one stretch."""
        return min(max_piece(self.capacity), self.size - self.end % self.size)

    def stretch(self, row: int, count: int) -> Columns:
        """View successive rows that were written in one stretch."""
        slot = row % self.size
        return Columns(*(column[slot : slot + count] for column in self.slots))

    def _previous(self, segment: Segment) -> int:
        """Find the row of the step before a segment; it must have the very same observation.

        The length alone is not enough: of two episodes with segments lost between them, one may
        seem to go on where the other was left.
        """
        tail = self._tails.get((segment.actor, segment.env))
        before = segment.episode_length - segment.num_steps
        if tail is None or tail.episode_length != before:
            return -1
        row = tail.end - 1
        return row if np.array_equal(self.slots.next_obs[row % self.size], segment.obs[0]) else -1

    def _remember(self, record: Record) -> None:
        stream = (record.actor, record.env)
        if record.flags & (TERMINATED | TRUNCATED):
            self._tails.pop(stream, None)
            return
        self._tails[stream] = record
        if len(self._tails) > self._max_tails:
            self._tails = {k: t for k, t in self._tails.items() if t.end > self.begin}
            self._max_tails = max(_MIN_TAILS, 2 * len(self._tails))
