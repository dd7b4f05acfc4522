"""The on-policy variant: every batch is learned from once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

import torch

from a2s.learner.export.on_policy import export
from a2s.learner.ingest.batching import to_batch
from a2s.learner.on_policy.authors import Authors
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.presets import AnyOnPolicyConfig
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.on_policy.update import OnPolicy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Outcome, Quota, Saved
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.messages import MOST_SUGGESTED, Segment
from a2s.protocol.transport import Bus

_HOLD_S = 0.05
_TESTED = ("draw", "probability", "r", "r_best")
COLUMNS = (
    *(field.name for field in fields(UpdateStats) if field.name != "recovery"),
    *(f"recovery_{name}" for name in _TESTED),
)


class OnPolicyLearning:
    """Algorithm 1 of the paper, or A2C, behind `a2s.learner.trainer.Learning`.

    Args:
        spaces: Of the environment.
        hyper: Hyperparameters.
        seed: Of the run.
        metrics: Where updates are shown.
        saved: A `state` to go on from.

    Raises:
        RunDirectoryError: ``saved`` does not fit.
    """

    columns = COLUMNS
    most_suggested = MOST_SUGGESTED

    def __init__(
        self,
        spaces: Spaces,
        hyper: AnyOnPolicyConfig,
        seed: int,
        metrics: LearnerMetrics,
        saved: Saved | None,
    ) -> None:
        self._metrics = metrics
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
        self.plays_on = hyper.max_policy_lag > 0

    @property
    def updates(self) -> int:
        """Batches learned from."""
        return self._algorithm.updates

    def quota(self, num_envs: int) -> Quota:
        """An equal share of the next batch for each environment."""
        steps, episodes = self._algorithm.next_batch
        each = max(1, math.ceil(steps / num_envs)), math.ceil(episodes / num_envs)
        return Quota(steps, *each)

    def graph(
        self, version: int, progress: float, metadata: Mapping[str, str], *, to_keep: bool = False
    ) -> bytes:
        """Suggester with Q, as soon as that may choose; the same to keep."""
        del to_keep
        return export(self._algorithm.suggester(*self._bounds, progress), version, dict(metadata))

    def keep(self, segment: Segment) -> None:
        """Nothing is stored: a batch is forgotten once it was learned from."""

    def hold_s(self, pending_batches: float) -> float:
        """A little while a batch waits: what is played meanwhile may be stale."""
        return _HOLD_S if pending_batches >= 1 else 0.0

    def learn(self, segments: Sequence[Segment], progress: float, *, is_behind: bool) -> Outcome:
        """Make one update, or a recovery."""
        stats = self._algorithm.update(to_batch(segments), progress, is_behind=is_behind)
        self._metrics.show_update(stats)
        tested = {f"recovery_{n}": getattr(stats.recovery, n, None) for n in _TESTED}
        return Outcome(asdict(stats) | tested, stats.kl, stats.recovery, stats.restored_version)

    def state(self) -> Saved:
        """Of the algorithm."""
        return self._algorithm.state()

    def serve(self, bus: Bus, keys: Keys, generation: int) -> None:
        """There is nothing to ask for."""

    def close(self) -> None:
        """There is no file."""
