"""The replay of the run itself: filled by its actors, learned from at the limiter's pace."""

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.store import Quota
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy_trainer import draw_batch, draw_returns
from a2s.learner.prior import Prior
from a2s.learner.replay import directory, files
from a2s.learner.replay.limiter import Limiter
from a2s.learner.replay.replay import Replay
from a2s.learner.replay.ring import Rows
from a2s.learner.replay.sampling import Transitions
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import Segment

logger = logging.getLogger(__name__)

_MIN_HOLD_S = 0.02


class OwnReplay:
    """A `Store` and the `Source` of an `OffPolicyTrainer`: segments go in, batches come out.

    ``ledger`` knows which segments were acknowledged. ``saved`` is a `state` to go on from; rows of
    batches that were not closed by then are taken back if they come ``again``. All others that had
    not been learned from belong to the next batch. ``prior`` has a share of every batch.
    ``replay`` has the rows: those of a batch are inserted when it is closed, in an order that does
    not depend on that of their arrival, so that what is drawn does not depend on time; until then
    the journal has them.

    Raises:
        RunDirectoryError: The replay cannot be made or opened, or ``saved`` does not fit.
        UsageError: The hyperparameters contradict each other.
    """

    columns: tuple[str, ...] = ("gradient_steps", "replay_rows", "samples_per_insert_error")
    max_policy_lag: int | None = None
    max_suggestion = 1.001  # 1, and what rounding may add

    def __init__(
        self,
        path: Path,
        env_id: str,
        spaces: Spaces,
        hyper: OffPolicyConfig,
        seed: int,
        ledger: Ledger,
        metrics: LearnerMetrics,
        saved: Mapping[str, Any] | None = None,
        prior: Prior | None = None,
        *,
        again: bool = False,
    ) -> None:
        self._hyper, self._metrics, self._prior = hyper, metrics, prior
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
        samples_per_step = hyper.utd_ratio * hyper.batch_rows
        self._limiter = Limiter(
            samples_per_step,
            hyper.warm_up_steps,
            max(hyper.lead_steps * samples_per_step, hyper.batch_rows),
            segment_steps=hyper.send_every_steps,
            batch_size=hyper.batch_rows,
        )
        self.short_steps = hyper.short_steps
        self._quota_steps = hyper.send_every_steps
        self._update_s = 0.01
        self._waiting: list[tuple[int, Segment]] = []
        self._num_learned = saved["learned_from"] if saved else 0  # of all rows ever inserted
        num_closed = saved.get("closed", self._num_learned) if saved else 0
        self.replay = _open(path, env_id, spaces, hyper, ledger, num_closed, again=again)
        num_rows = self.replay.live.stop
        self._limiter.count_insert(num_rows)
        if saved is not None:
            self._limiter.load(saved["limiter"], num_rows)
            self.replay.highest_priority = saved["highest_priority"]
            self._rng.bit_generator.state = saved["rng"]
        self._shown_waits = self._waits()  # by this process
        self.close_batch()
        torn = self.replay.torn_records
        metrics.replay_torn.inc(torn)
        if torn:
            logger.warning("replay %s: cut %d torn records at its end", path, torn)
        self._show()

    # For ingest.

    def quota(self, num_envs: int) -> Quota:
        """As many steps of every environment as an actor sends at once, if it may send them all.

        Actors are held back when learning is behind: a round that waited for more steps than they
        may send would wait long.
        """
        steps = self._hyper.send_every_steps
        self._quota_steps = steps * num_envs
        return Quota(max(1, min(self._quota_steps, self._limiter.free_inserts)), steps, 0)

    def store(self, slot: int, segment: Segment) -> None:
        """Take a segment, to be inserted when the batch is closed."""
        self._waiting.append((slot, segment))
        self._limiter.count_insert(segment.num_steps)

    def close_batch(self) -> None:
        """Insert what was taken; updates are due for the rows so far, and no more."""
        self._insert_waiting()
        self._new_obs = self.replay.obs_since(self._num_learned)
        self._num_closed = self.replay.live.stop

    def hold_s(self, num_batches: float) -> float:
        """Time that learning needs to be back within its band, at the best pace of its last round.

        Not at the mean one: the first update ever compiles for seconds. Never longer than a round,
        for the next one begins only when more was played.
        """
        if self._limiter.may_insert():
            return 0.0
        behind = self._limiter.excess / self._hyper.batch_rows
        return min(max(behind * self._update_s, _MIN_HOLD_S), self._max_updates * self._update_s)

    # For the trainer.

    def new_obs(self, updates: int) -> Array:
        """Observations of the rows of this batch, and as many prior ones as belong to them."""
        learned, self._num_learned = self._num_learned, self._num_closed
        if self._prior is None:
            return self._new_obs
        beside = self._prior.obs_beside(learned, self._num_closed, self._rng)
        return np.concatenate([self._new_obs, beside])

    def may_update(self, updates: int, made: int) -> bool:
        """Whether one is due for the rows of this batch.

        A round with much to catch up with ends at twice the updates that a quota asks for.
        """
        return made < self._max_updates and self._limiter.may_sample(self._num_learned)

    def draw_returns(self, updates: int) -> Array:
        """Draw discounted returns."""
        return draw_returns(self.replay, self._hyper, self._rng, self._prior)

    def draw(self, updates: int) -> Transitions:
        """Draw the batch of an update."""
        return draw_batch(self.replay, self._hyper, self._rng, self._prior)

    def learned(self, row: Rows, error: Tensor) -> None:
        """Count the batch, and let errors become priorities where they count."""
        if self._hyper.prioritised:
            self.replay.update_priorities(row, error[: len(row)].cpu().numpy())
        self._limiter.count_sample()

    def end_round(self, made: int, update_s: float) -> Mapping[str, object]:
        """Show where sampling stands."""
        self._update_s = update_s if made else self._update_s
        self._show()
        return dict(zip(self.columns, (made, len(self.replay), self._limiter.error), strict=True))

    def state(self) -> dict[str, object]:
        """Of the limiter and the draws; the rows are on the disk."""
        self.replay.flush()
        return {
            "learned_from": self._num_learned,
            "closed": self._num_closed,  # more at the end of a run: its last batch is not learned
            "limiter": self._limiter.state(self._num_learned),
            "highest_priority": self.replay.highest_priority,
            "rng": self._rng.bit_generator.state,
            "prior": self._prior.identity if self._prior else "",
        }

    def close(self) -> None:
        """Insert what waits, to be there for who reads the files, and close them."""
        self._insert_waiting()
        self.replay.close()
        if self._prior is not None:
            self._prior.close()

    @property
    def _max_updates(self) -> int:
        """Updates of a round at most."""
        return 2 * math.ceil(self._quota_steps * self._hyper.utd_ratio)

    def _insert_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for _, segment in sorted(waiting, key=lambda each: (each[0], each[1].env, each[1].seq)):
            self.replay.insert(segment)

    def _waits(self) -> dict[str, int]:
        return {"insert": self._limiter.insert_waits, "sample": self._limiter.sample_waits}

    def _show(self) -> None:
        self._metrics.replay_rows.set(len(self.replay))
        self._metrics.limiter_error.set(self._limiter.error)
        waits = self._waits()
        for side, count in waits.items():
            self._metrics.limiter_waits.labels(side=side).inc(count - self._shown_waits[side])
        self._shown_waits = waits


def _open(
    path: Path,
    env_id: str,
    spaces: Spaces,
    hyper: OffPolicyConfig,
    ledger: Ledger,
    num_closed: int,
    *,
    again: bool,
) -> Replay:
    """Open the replay that is there, given the wanted capacity; else make one."""
    alpha, capacity, batch_size = hyper.priority_exponent, hyper.replay_rows, hyper.batch_rows
    if not (path / files.NAME).exists():
        if num_closed:
            raise RunDirectoryError(
                f"replay {path}: is not there any more; restore it, or begin another run with "
                f"--init-from {path.parent}"
            )
        return directory.create(path, env_id, spaces, capacity, batch_size=batch_size, alpha=alpha)
    return directory.open_existing(
        path,
        env_id=env_id,
        spaces=spaces,
        capacity=capacity,
        batch_size=batch_size,
        is_known=ledger.knows,
        least_rows=num_closed,
        most_rows=num_closed if again else None,
        alpha=alpha,
    )
