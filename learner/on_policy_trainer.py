"""The on-policy variant: learns from every batch once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

import numpy as np
import torch

from a2s.learner.export.on_policy import export
from a2s.learner.ingest.store import Quota
from a2s.learner.on_policy.authors import Authors
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.presets import AnyOnPolicyConfig
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.on_policy.update import OnPolicy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Outcome, Saved
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import MAX_SUGGESTED, Segment

_HOLD_S = 0.05
_TESTED = ("draw", "probability", "r", "r_best")
COLUMNS = (
    *(field.name for field in fields(UpdateStats) if field.name != "recovery"),
    *(f"recovery_{name}" for name in _TESTED),
)


class OnPolicyTrainer:
    """Algorithm 1 of the paper, or A2C: a `Trainer`, and the `Store` of its batches.

    Every graph has ``metadata``; ``saved`` is a `state` to go on from.

    Raises:
        RunDirectoryError: ``saved`` does not fit.
    """

    columns = COLUMNS
    max_suggestion = MAX_SUGGESTED
    short_steps = 0

    def __init__(
        self,
        spaces: Spaces,
        hyper: AnyOnPolicyConfig,
        seed: int,
        metadata: Mapping[str, str],
        metrics: LearnerMetrics,
        saved: Saved | None = None,
    ) -> None:
        self._metadata, self._metrics = metadata, metrics
        self._bounds = torch.tensor(spaces.action_low), torch.tensor(spaces.action_high)
        sizes = spaces.obs_size, spaces.action_size
        self._algorithm: OnPolicy | Authors = (
            OnPolicy(*sizes, hyper, seed)
            if isinstance(hyper, OnPolicyConfig)
            else Authors(*sizes, hyper, seed)
        )
        if saved is not None:
            self._algorithm.load(*saved)
        self.max_policy_lag: int | None = hyper.max_policy_lag
        self.overlaps_learning = hyper.act_while_learning
        self._stored: list[tuple[int, Segment]] = []
        self._batch: list[Segment] = []
        self._first_version = math.inf  # that the present networks were given, once they were

    @property
    def updates(self) -> int:
        """Batches learned from."""
        return self._algorithm.updates

    def quota(self, num_envs: int) -> Quota:
        """An equal share of the next batch for each environment."""
        steps, episodes = self._algorithm.next_batch
        each = max(1, math.ceil(steps / num_envs)), math.ceil(episodes / num_envs)
        return Quota(steps, *each)

    def store(self, slot: int, segment: Segment) -> None:
        """Put a segment into the batch that is being played."""
        self._stored.append((slot, segment))

    def close_batch(self) -> None:
        """Order the batch by slots, environments and numbers, not by arrival."""
        stored, self._stored = self._stored, []
        stored.sort(key=lambda pair: (pair[0], pair[1].env, pair[1].seq))
        self._batch = [segment for _, segment in stored]

    def hold_s(self, num_batches: float) -> float:
        """A short time while a batch waits: steps played meanwhile may be stale."""
        return _HOLD_S if num_batches >= 1 else 0.0

    def graph(self, version: int, progress: float, *, averaged: bool = False) -> bytes:
        """Suggester with Q, as soon as that may choose; there is no average."""
        self._first_version = min(self._first_version, version)
        suggester = self._algorithm.suggester(*self._bounds)
        return export(suggester, version, dict(self._metadata))

    def learn(self, progress: float) -> Outcome:
        """Make one update, or a recovery; the batch is forgotten."""
        made_by = max(segment.weights_version for segment in self._batch)
        is_behind = made_by < self._first_version < math.inf
        stats = self._algorithm.update(to_batch(self._batch), progress, is_behind=is_behind)
        self._batch, self._first_version = [], math.inf
        self._metrics.show_update(stats)
        tested = {f"recovery_{n}": getattr(stats.recovery, n, None) for n in _TESTED}
        return Outcome(asdict(stats) | tested, stats.kl, stats.recovery, stats.restored_version)

    def state(self) -> Saved:
        """The state of the algorithm."""
        return self._algorithm.state()

    def begin_with(self, saved: Saved, taken: Sequence[str]) -> None:
        """Take parts of another run's state; the unit of V and Q goes with them."""
        self._algorithm.begin_with(*saved, taken)

    def close(self) -> None:
        """There are no files to close."""


def to_batch(segments: Sequence[Segment]) -> Batch:
    """Put segments one after the other."""

    def joined(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(s, name) for s in segments]))

    returns = [s.episode_return for s in segments if s.ends_episode]
    return Batch(
        obs=joined("obs"),
        suggestion=joined("suggestion"),
        log_prob=joined("log_prob"),
        reward=joined("reward"),
        lengths=torch.tensor([s.num_steps for s in segments]),
        weights_version=torch.tensor([s.weights_version for s in segments]),
        final_obs=torch.from_numpy(np.stack([s.final_obs for s in segments])),
        terminated=torch.tensor([s.terminated for s in segments]),
        truncated=torch.tensor([s.truncated for s in segments]),
        episode_returns=torch.tensor(returns, dtype=torch.float32),
    )
