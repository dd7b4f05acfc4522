"""The off-policy variant: learns from a replay again and again."""

import math
import time
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from a2s.learner.export.off_policy import export
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.recorded_update import update_of
from a2s.learner.off_policy.stats import SHOWN, OffPolicyStats, RoundMeans
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.prior import Prior
from a2s.learner.replay import sampling
from a2s.learner.replay.remote import RemoteReplay
from a2s.learner.replay.replay import Replay
from a2s.learner.replay.ring import Rows
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Outcome, Saved
from a2s.protocol.errors import A2SError
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.replay_messages import MAX_STEPS

_RETURNS_EVERY_UPDATES = 20

AnyReplay = Replay | RemoteReplay


def draw_batch(
    replay: AnyReplay,
    hyper: OffPolicyConfig,
    rng: np.random.Generator,
    prior: Prior | None = None,
) -> sampling.Transitions:
    """Draw the batch of an update; the rows of ``prior`` are the last ones."""
    own = replay.sample(
        hyper.batch_rows - (prior.rows if prior else 0),
        rng,
        n_step=hyper.n_step,
        gamma=hyper.gamma,
        prioritised=hyper.prioritised,
        beta=hyper.importance_exponent,
    )
    if prior is None:
        return own
    return sampling.joined(own, prior.sample(rng, n_step=hyper.n_step, gamma=hyper.gamma))


def draw_returns(
    replay: AnyReplay,
    hyper: OffPolicyConfig,
    rng: np.random.Generator,
    prior: Prior | None = None,
) -> Array:
    """Draw discounted returns, over as many steps as any replay adds up: float32 ``[B]``."""
    rows = hyper.batch_rows - (prior.rows if prior else 0)
    own = replay.sample(rows, rng, n_step=MAX_STEPS, gamma=hyper.gamma)
    if prior is None:
        return own.reward
    drawn = prior.sample(rng, n_step=MAX_STEPS, gamma=hyper.gamma)
    return np.concatenate([own.reward, drawn.reward])


class Source(Protocol):
    """The source of batches: the run's own replay, or another run's.

    ``columns`` are its own columns of ``updates.csv``.
    """

    columns: tuple[str, ...]

    def new_obs(self, updates: int) -> Array:
        """Observations that the normaliser has not seen, ``[N, D]``; asked once a round."""
        ...

    def may_update(self, updates: int, made: int) -> bool:
        """Whether the next of all updates belongs to this round, after ``made`` of them."""
        ...

    def draw_returns(self, updates: int) -> Array:
        """Draw discounted returns before the next update, float32 ``[B]``."""
        ...

    def draw(self, updates: int) -> sampling.Transitions:
        """Draw the batch of the next update."""
        ...

    def learned(self, row: Rows, error: Tensor) -> None:
        """An update was made of these rows; ``error`` is that of each, ``[B]``."""
        ...

    def end_round(self, made: int, update_s: float) -> Mapping[str, object]:
        """Show and return the values of `columns`; the fastest update took ``update_s``."""
        ...

    def state(self) -> dict[str, object]:
        """What a checkpoint holds, fit for JSON."""
        ...

    def close(self) -> None:
        """Close files."""
        ...


class OffPolicyTrainer:
    """Algorithm 2 of the paper and its extensions: a `Trainer`.

    ``algorithm`` is in the state to go on from, after ``updates`` updates; batches come from
    ``source``; every graph has ``metadata``. What it ``knows`` before the first update is from
    another run.
    """

    overlaps_learning = False

    def __init__(
        self,
        algorithm: OffPolicy,
        source: Source,
        spaces: Spaces,
        metadata: Mapping[str, str],
        metrics: LearnerMetrics,
        updates: int = 0,
        *,
        knows: bool = False,
    ) -> None:
        self._algorithm, self._source = algorithm, source
        self._metadata, self._metrics = metadata, metrics
        self._bounds = torch.tensor(spaces.action_low), torch.tensor(spaces.action_high)
        self._update = update_of(algorithm)
        self._updates, self._knows = updates, knows
        metrics.count_gradient_steps(updates, updates // algorithm.hyper.policy_every)
        self.columns = (*source.columns, *SHOWN)

    @property
    def updates(self) -> int:
        """Gradient updates made."""
        return self._updates

    def graph(self, version: int, progress: float, *, averaged: bool = False) -> bytes:
        """Uniform actions until there is enough to learn from, then the suggester."""
        warms_up = self._updates == 0 and not self._knows
        suggester = self._algorithm.suggester(*self._bounds, warms_up=warms_up, averaged=averaged)
        return export(suggester, version, self._metadata)

    def learn(self, progress: float) -> Outcome:
        """Make the updates of a round, then let actors have the new weights.

        Raises:
            A2SError: The networks are no longer finite, or the source refuses, or is gone.
        """
        new_obs = self._source.new_obs(self._updates)
        if len(new_obs):
            self._algorithm.observe(torch.from_numpy(new_obs))
        means, update_s = RoundMeans(), math.inf
        while self._source.may_update(self._updates, means.updates):
            begin_s = time.monotonic()
            means.add(self._learn_once())
            update_s = min(update_s, time.monotonic() - begin_s)
        self._require_finite()
        row = means.means()
        if means.updates:
            self._metrics.show_off_policy(row, means.counts)
        return Outcome(row | dict(self._source.end_round(means.updates, update_s)))

    def begin_with(self, saved: Saved, taken: Sequence[str]) -> None:
        """Take parts of another run's state; actors then play them from the beginning."""
        self._algorithm.begin_with(saved[0], taken)
        self._knows = True

    def state(self) -> Saved:
        """The state of the algorithm and the source.

        Raises:
            A2SError: The networks are no longer finite.
        """
        self._require_finite()
        numbers = {"updates": self._updates, "knows": self._knows}
        return self._algorithm.state(), numbers | self._source.state()

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def _require_finite(self) -> None:
        if not self._algorithm.is_finite():
            raise A2SError(f"update {self._updates}: found non-finite weights, expected finite")

    def _learn_once(self) -> OffPolicyStats:
        normalises = self._algorithm.hyper.norm_return
        if normalises and self._updates % _RETURNS_EVERY_UPDATES == 0:
            returns = self._source.draw_returns(self._updates)
            self._algorithm.observe_returns(torch.from_numpy(returns))
        drawn = self._source.draw(self._updates)
        tensors = (torch.from_numpy(getattr(drawn, name)) for name in Transitions._fields)
        self._updates += 1
        every = self._algorithm.hyper.policy_every
        stats = self._update(Transitions(*tensors), learns_policy=self._updates % every == 0)
        self._source.learned(drawn.row, stats.error)
        return stats
