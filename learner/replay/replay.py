"""The replay of a run: the newest transitions of many episodes, to be sampled again and again."""

import threading
from typing import Self

import numpy as np

from a2s.learner.replay.files import Description, Files
from a2s.learner.replay.ring import Floats, Ring, Rows, make_columns
from a2s.learner.replay.sampling import Priorities, Transitions, draw_uniform, gather
from a2s.protocol.errors import MalformedMessageError, UsageError
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import Segment


class Replay:
    """Transitions, inserted by segments and sampled one by one; any thread may call it.

    Made by the functions of `a2s.learner.replay.directory`, or `in_memory`. Use::

        replay.insert(segment)  # then write it into the ledger, then acknowledge it
        batch = replay.sample(256, rng, n_step=3, gamma=0.99, prioritised=True)
        replay.update_priorities(batch.row, np.abs(td_error))

    Attributes:
        about: Environment and capacity.
        torn_records: Pieces of segments that a kill had torn, cut when the replay was opened.
        taken_back: Rows cut then because the ledger did not know their segment.
    """

    def __init__(
        self,
        about: Description,
        ring: Ring,
        priorities: Priorities,
        files: Files | None = None,
        *,
        torn_records: int = 0,
        taken_back: int = 0,
    ) -> None:
        self.about = about
        self.torn_records = torn_records
        self.taken_back = taken_back
        self._ring = ring
        self._priorities = priorities
        self._files = files
        self._guard = threading.Lock()

    @classmethod
    def in_memory(cls, env_id: str, spaces: Spaces, capacity: int, *, alpha: float = 0.6) -> Self:
        """Make one that dies with this process; arguments as for `directory.create`."""
        about = Description(env_id=env_id, spaces=spaces, capacity=capacity, files=0)
        columns = make_columns(spaces, capacity, lambda _, shape: np.zeros(shape, np.float32))
        ring = Ring(capacity, columns)
        return cls(about, ring, Priorities(ring, np.zeros(ring.size, np.float32), alpha))

    def __len__(self) -> int:
        return len(self.live)

    @property
    def live(self) -> range:
        """Numbers of the rows that can be sampled; its stop is how many were ever inserted."""
        with self._guard:
            return range(self._ring.begin, self._ring.end)

    @property
    def highest_priority(self) -> float:
        """The priority of a new row; a resumed run sets it, to go on to the bit."""
        return self._priorities.highest

    @highest_priority.setter
    def highest_priority(self, value: float) -> None:
        self._priorities.highest = value

    def insert(self, segment: Segment) -> range:
        """Add the steps of a segment, evicting as many of the oldest as do not fit.

        In a directory they survive the death of this process when this returns the numbers of
        their rows.

        Raises:
            UsageError: The replay is read only or closed.
            MalformedMessageError: The segment is of another environment.
            RunDirectoryError: It cannot be written down; open the replay anew before going on.
        """
        self._require_fit(segment)
        with self._guard:
            first = self._ring.end
            while (done := self._ring.end - first) < segment.num_steps:
                self._insert_piece(segment, done)
            return range(first, self._ring.end)

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        *,
        n_step: int = 1,
        gamma: float = 0.99,
        prioritised: bool = False,
        beta: float = 0.4,
    ) -> Transitions:
        """Draw transitions with replacement; the same generator draws the same.

        Each goes over ``n_step`` steps, or fewer where the episode ends before, or is not known
        further; it never leaves the episode. The draw is uniform or in proportion to the
        priorities; then importance weights make up for that, with ``beta`` 0 not, with 1 fully.

        Raises:
            UsageError: The replay is empty, or B or n is below 1.
        """
        if batch_size < 1 or n_step < 1:
            raise UsageError(
                f"replay: found batch of {batch_size} and n_step {n_step}, expected at least 1"
            )
        with self._guard:
            if not len(self._ring):
                raise UsageError("replay: found no transition to sample, insert some first")
            if prioritised:
                row, weight = self._priorities.draw(batch_size, beta, rng)
            else:
                row, weight = draw_uniform(self._ring, batch_size, rng)
            return gather(self._ring, row, weight, n_step, gamma)

    def obs_since(self, row: int) -> Array:
        """Observations of the rows from this number on that are still there, ``[N, D]``."""
        with self._guard:
            rows = np.arange(max(row, self._ring.begin), self._ring.end)
            return self._ring.slots.obs[self._ring.slot(rows)]

    def update_priorities(self, row: Rows, priority: Array | Floats) -> None:
        """Set the priorities, for example absolute TD errors, of sampled rows, ``[B]``.

        Rows that were evicted since are passed over; of two priorities of one row the last counts.

        Raises:
            UsageError: A priority is negative or not finite.
        """
        values = np.asarray(priority, np.float64)
        highest = float(values.max(initial=0.0))
        if not (values.size and values.min() >= 0.0 and highest < np.inf):
            raise UsageError("replay: found a negative or non-finite priority, expected 0 or more")
        with self._guard:
            if row.min() < self._ring.begin:
                live = row >= self._ring.begin
                row, values = row[live], values[live]
            self._priorities.assign(row, values, highest)

    def flush(self) -> None:
        """Write everything to the disk, in case the machine dies."""
        if self._files is not None:
            self._files.flush()

    def close(self) -> None:
        """Close the files; may be called twice."""
        if self._files is not None:
            self._files.close()

    def _require_fit(self, segment: Segment) -> None:
        if self._files is not None and self._files.index is None:
            raise UsageError("replay: is open to be read only, or closed")
        spaces = self.about.spaces
        expected = (spaces.obs_size, spaces.action_size)
        found = (segment.obs.shape[1], segment.suggestion.shape[1])
        if found != expected:
            raise MalformedMessageError(
                f"segment {segment.actor}/{segment.seq}: found obs_size and action_size {found}, "
                f"expected {expected}"
            )

    def _insert_piece(self, segment: Segment, begin: int) -> None:
        ring, oldest = self._ring, self._ring.begin
        record = ring.write(segment, begin)
        if self._files is not None and self._files.index is not None:
            rows = ring.stretch(record.row, record.steps)
            record = record._replace(rows_hash=rows.checksum())
            self._files.index.append(record.pack(), oldest)
        ring.admit(record)
        self._priorities.admit(record.row, record.end)
        self._priorities.evict(oldest, ring.begin)
