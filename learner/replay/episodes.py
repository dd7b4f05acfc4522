"""Whole episodes, put together again from the segments that a replay was filled with."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from a2s.learner.replay.files import describe
from a2s.learner.replay.index import STARTS, TERMINATED, TRUNCATED, Record
from a2s.learner.replay.repair import Repair
from a2s.learner.replay.ring import Columns
from a2s.protocol.fields import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Episode:
    """An episode of T steps from its first to its last.

    Attributes:
        obs: Observations, the last one included, float32 ``[T + 1, D]``.
        action: Executed suggestions, canonical, not clipped, float32 ``[T, A]``.
        reward: float32 ``[T]``.
        terminated: The last step reached a terminal state; else it hit a time limit.
    """

    obs: Array
    action: Array
    reward: Array
    terminated: bool


class StoredEpisodes:
    """The whole episodes of a replay directory, in order of their ends.

    A learner may write to the directory meanwhile.

    Attributes:
        about: Environment and capacity.
        left_out: Episodes met so far of which not all steps are there: the first ones are
            evicted, some were lost, it is not over yet, or it was short and left before its end.

    Raises:
        RunDirectoryError: There is no replay, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.about = describe(path)
        self._found = Repair(path, self.about)
        self.left_out = 0

    def __iter__(self) -> Iterator[Episode]:
        self.left_out = 0
        begun: dict[tuple[str, int], list[Record]] = {}
        for record in self._found.live:
            stream = (record.actor, record.env)
            known = begun.pop(stream, [])
            if known and not _may_follow(known[-1], record):
                self.left_out += 1
                known = []
            records = [*known, record]
            if not record.flags & (TERMINATED | TRUNCATED):
                begun[stream] = records
                continue
            episode = self._join(records) if self._is_whole(records) else None
            if episode is None:
                self.left_out += 1
            else:
                yield episode
        self.left_out += len(begun)

    def _is_whole(self, records: list[Record]) -> bool:
        first = records[0]
        linked = all(b.previous == a.end - 1 for a, b in pairwise(records))
        return bool(first.flags & STARTS) and first.row >= self._found.ring.begin and linked

    def _join(self, records: list[Record]) -> Episode | None:
        """Put the rows of an episode together, unless some were overwritten meanwhile."""
        pieces = []
        for record in records:
            rows = self._found.ring.stretch(record.row, record.steps)
            piece = Columns(*(column.copy() for column in rows))
            if piece.checksum() != record.rows_hash:
                return None
            pieces.append(piece)
        return Episode(
            obs=np.concatenate([*(p.obs for p in pieces), pieces[-1].next_obs[-1:]]),
            action=np.concatenate([p.action for p in pieces]),
            reward=np.concatenate([p.outcome[:, 0] for p in pieces]),
            terminated=bool(records[-1].flags & TERMINATED),
        )


def _may_follow(last: Record, record: Record) -> bool:
    """Whether two records of one stream can be of the same episode."""
    before = record.episode_length - record.steps
    return record.previous == last.end - 1 or before > last.episode_length
