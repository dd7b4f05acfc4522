"""The segments that a replay was filled with, as far as they are still there."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from a2s.learner.replay.files import describe, locked
from a2s.learner.replay.index import TERMINATED, TRUNCATED, Record
from a2s.learner.replay.repair import Repair
from a2s.protocol.messages import Segment


class StoredSegments:
    """Those of a replay directory, oldest first; learners are kept out until it is closed.

    A long segment comes in several parts. Inserted into another replay of ``num_steps`` rows, they
    make the same transitions, with the same links.

    Attributes:
        about: Environment and capacity.
        num_steps: Live rows. The first segment may have more, of which the first ones are evicted.

    Raises:
        RunDirectoryError: There is no replay, it is damaged, or a learner writes to it.
    """

    def __init__(self, path: Path) -> None:
        self.about = describe(path)
        with locked(path, to_read=True) as lock_file:
            self._found = Repair(path, self.about)
            self._found.files.lock_file = lock_file
        self.num_steps = len(self._found.ring)

    def __iter__(self) -> Iterator[Segment]:
        return map(self._read, self._found.live)

    def close(self) -> None:
        """Let learners in again."""
        self._found.files.close()

    def _read(self, record: Record) -> Segment:
        rows = self._found.ring.stretch(record.row, record.steps)
        return Segment(
            actor=record.actor,
            seq=record.seq,
            generation=1,  # nobody asks for what is not in a replay: this, and zeros below
            epoch=0,
            weights_version=0,
            env=record.env,
            obs=rows.obs,
            suggestion=rows.action,
            log_prob=np.zeros(record.steps, np.float32),
            reward=rows.outcome[:, 0],
            final_obs=rows.next_obs[-1],
            terminated=bool(record.flags & TERMINATED),
            truncated=bool(record.flags & TRUNCATED),
            episode_return=0.0,
            episode_length=record.episode_length,
        )
