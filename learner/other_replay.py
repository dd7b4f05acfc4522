"""Another run's replay, to learn from without actors: its files, or what its learner serves."""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from torch import Tensor

from a2s.learner.feed import Arrival, Feed
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy_trainer import AnyReplay, draw_batch, draw_returns
from a2s.learner.replay.ring import Rows
from a2s.learner.replay.sampling import Transitions
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Trainer
from a2s.protocol.codec import MAX_BYTES, MIB
from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.replay_messages import MAX_SAMPLED, ReplaySample

_ROUND = 100
_BATCH, _RETURNS, _STATISTICS = 1, 2, 3
_ANSWER_BYTES = MAX_BYTES[ReplaySample] - MIB  # the rest is for what is not rows
_ASK_AGAIN_S = 1.0


class OtherReplay:
    """The `Source` of an `OffPolicyTrainer`; the next batch is fetched while one is learned from.

    Nothing is changed there: priorities are the other learner's own. Every draw has a generator of
    its own, so that a batch drawn ahead of a checkpoint is drawn again. ``size`` returns the number
    of transitions it holds now; ``max_size`` is the most it will ever hold: its capacity, or its
    stored rows.

    Attributes:
        wanted: Transitions to wait for: as with actors, or all there can be if that is less.

    Raises:
        UsageError: The replay never holds a whole batch.
    """

    columns: tuple[str, ...] = ("replay_rows",)

    def __init__(
        self,
        replay: AnyReplay,
        size: Callable[[], int],
        max_size: int,
        spaces: Spaces,
        hyper: OffPolicyConfig,
        seed: int,
        metrics: LearnerMetrics,
    ) -> None:
        if max_size < hyper.batch_rows:
            raise UsageError(
                f"replay: found {max_size} transitions at most, expected a batch of "
                f"{hyper.batch_rows}; set batch_rows, or name another replay"
            )
        self._replay, self.size, self._hyper, self._seed = replay, size, hyper, seed
        self._metrics = metrics
        self.wanted = min(max(hyper.warm_up_steps, hyper.batch_rows), max_size)
        row_bytes = 8 * (spaces.obs_size + spaces.action_size + 3)
        self._statistics_rows = min(MAX_SAMPLED, _ANSWER_BYTES // row_bytes)
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="replay")
        self._coming: Future[Transitions] | None = None

    def new_obs(self, updates: int) -> Array:
        """As many as a message takes before the first update, then a batch of them a round."""
        rows = self._hyper.batch_rows if updates else self._statistics_rows
        rng = self._generator(_STATISTICS, updates)
        return self._ahead.submit(self._replay.sample, rows, rng).result().obs

    def may_update(self, updates: int, made: int) -> bool:
        """Rounds end at every hundredth update."""
        return made == 0 or updates % _ROUND > 0

    def draw_returns(self, updates: int) -> Array:
        """Draw discounted returns."""
        rng = self._generator(_RETURNS, updates)
        return self._ahead.submit(draw_returns, self._replay, self._hyper, rng).result()

    def draw(self, updates: int) -> Transitions:
        """Take the batch of an update, and have the next one drawn."""
        coming = self._coming or self._submit(updates)
        batch, self._coming = coming.result(), self._submit(updates + 1)
        return batch

    def learned(self, row: Rows, error: Tensor) -> None:
        """The other learner has its own errors."""

    def end_round(self, made: int, update_s: float) -> Mapping[str, object]:
        """Show its size."""
        size = self.size()
        self._metrics.replay_rows.set(size)
        return {"replay_rows": size}

    def state(self) -> dict[str, object]:
        """Every draw follows from the seed and the number of updates."""
        return {}

    def close(self) -> None:
        """Draw no more; nobody needs the batch that was coming, nor why it did not come."""
        self._ahead.shutdown()

    def _submit(self, updates: int) -> Future[Transitions]:
        rng = self._generator(_BATCH, updates)
        return self._ahead.submit(draw_batch, self._replay, self._hyper, rng)

    def _generator(self, use: int, updates: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, use, updates])


class ReplayFeed(Feed):
    """Every batch is a round of updates, counted as steps: ``utd_ratio`` updates are worth one."""

    def __init__(
        self, source: OtherReplay, trainer: Trainer, utd_ratio: float, metrics: LearnerMetrics
    ) -> None:
        self._source, self._trainer, self._metrics = source, trainer, metrics
        self._updates_per_step = utd_ratio
        metrics.env_steps.inc(self.env_steps(trainer.updates))  # of earlier starts

    def env_steps(self, updates: int) -> int:
        """Environment steps that updates are worth."""
        return int(updates / self._updates_per_step)

    def next_batch(self, proceed: Callable[[str], bool]) -> list[Arrival]:
        """Wait until there is as much as wanted, then a round is due at once."""
        updates = self._trainer.updates
        while (found := self._source.size()) < self._source.wanted:
            if not proceed(f"{self._source.wanted} transitions, the replay has {found}"):
                return []
            time.sleep(_ASK_AGAIN_S)
        after = updates + _ROUND - updates % _ROUND
        steps = self.env_steps(after) - self.env_steps(updates)
        self._metrics.env_steps.inc(steps)
        return [Arrival(0, 0, 0, steps)]

    def next_version(self, version: int) -> int:
        """Nobody plays: weights are called by the number of updates."""
        return self._trainer.updates
