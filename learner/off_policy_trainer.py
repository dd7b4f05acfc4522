"""The off-policy variant: what was played is kept in a replay, and learned from again and again."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from a2s.learner.export.off_policy import export
from a2s.learner.ingest.batching import draw, draw_returns, wants_returns
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.off_policy_row import SHOWN, RoundMeans
from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.off_policy.recorded_update import update_of
from a2s.learner.off_policy.update import OffPolicy, OffPolicyStats
from a2s.learner.replay import directory, files
from a2s.learner.replay.limiter import Limiter
from a2s.learner.replay.remote import ServedReplay
from a2s.learner.replay.replay import Replay
from a2s.learner.run.config import Device
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Outcome, Quota, Saved
from a2s.protocol.errors import A2SError
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Segment
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

_LEAST_HOLD_S = 0.02
COLUMNS = ("gradient_steps", "replay_rows", "samples_per_insert_error", *SHOWN)


class OffPolicyLearning:
    """Algorithm 2 of the paper and what goes past it, behind `a2s.learner.trainer.Learning`.

    Args:
        env_id: Environment.
        spaces: Its spaces.
        hyper: Hyperparameters.
        seed: Of the run.
        path: Directory of the run; the replay is ``replay/`` in it.
        ledger: Knows which segments were acknowledged.
        metrics: Where updates are shown.
        device: Of the networks.
        saved: A `state` to go on from; what was inserted since then is still there, and due.

    Raises:
        RunDirectoryError: ``saved`` does not fit; or the replay cannot be made or opened.
        UsageError: The hyperparameters contradict each other.
    """

    columns = COLUMNS
    max_policy_lag: int | None = None
    most_suggested = 1.001  # 1, and what rounding may add
    plays_on = False

    def __init__(
        self,
        env_id: str,
        spaces: Spaces,
        hyper: OffPolicyHyper,
        seed: int,
        path: Path,
        ledger: Ledger,
        metrics: LearnerMetrics,
        device: Device,
        saved: Saved | None,
    ) -> None:
        self._hyper = hyper
        self._metrics = metrics
        self._bounds = torch.tensor(spaces.action_low), torch.tensor(spaces.action_high)
        self._algorithm = OffPolicy(spaces.obs_size, spaces.action_size, hyper, seed, device)
        if saved is not None:
            self._algorithm.load(saved[0])
        self._learn_from = update_of(self._algorithm)
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
        samples_per_step = hyper.updates_per_step * hyper.batch_rows
        self._limiter = Limiter(
            samples_per_step,
            hyper.warm_up_steps,
            max(hyper.lead_steps * samples_per_step, hyper.batch_rows),
            segment_steps=hyper.send_every_steps,
            batch_size=hyper.batch_rows,
        )
        self._updates = 0
        self._update_s = 0.01
        self._quota_steps = hyper.send_every_steps
        self._shown_waits: dict[str, int] = {}
        least_rows = 0 if saved is None else saved[1]["learned_from"]
        self._replay = _open(path / "replay", env_id, spaces, hyper, ledger, least_rows)
        self._limiter.count_insert(self._replay.live.stop)
        self._learned_from = 0
        if saved is not None:
            self._go_on(saved[1])
        self._observe_replay()
        torn = self._replay.torn_records
        metrics.replay_torn.inc(torn)
        if torn:
            logger.warning("replay %s: cut %d torn records at its end", path / "replay", torn)
        self._show()

    @property
    def updates(self) -> int:
        """Gradient updates made."""
        return self._updates

    def quota(self, num_envs: int) -> Quota:
        """As many steps of every environment as an actor sends at once, if it may send them all.

        Actors are held back when learning is behind: a round that waited for more steps than they
        may send would wait long.
        """
        steps = self._hyper.send_every_steps
        self._quota_steps = steps * num_envs
        batch_steps = min(self._quota_steps, self._limiter.free_inserts)
        return Quota(max(1, batch_steps), steps, 0)

    def graph(
        self, version: int, progress: float, metadata: Mapping[str, str], *, to_keep: bool = False
    ) -> bytes:
        """Uniform actions until there is enough to learn from, then the suggester."""
        del progress
        warms_up = self._updates == 0
        suggester = self._algorithm.suggester(*self._bounds, warms_up=warms_up, averaged=to_keep)
        return export(suggester, version, metadata)

    def keep(self, segment: Segment) -> None:
        """Put a segment into the replay; it survives the death of this process then."""
        self._replay.insert(segment)
        self._limiter.count_insert(segment.num_steps)

    def hold_s(self, pending_batches: float) -> float:
        """Time that learning needs to be back within its band, at the best pace of its last round.

        Not at the mean one: the first update ever compiles for seconds. Never longer than a round,
        for the next one begins only when more was played.
        """
        del pending_batches  # they are in the replay, whatever is played next
        if self._limiter.may_insert():
            return 0.0
        behind = self._limiter.excess / self._hyper.batch_rows
        return min(max(behind * self._update_s, _LEAST_HOLD_S), self._round * self._update_s)

    def learn(self, segments: Sequence[Segment], progress: float, *, is_behind: bool) -> Outcome:
        """Make the updates that are due, but then let actors have the new weights.

        Steps that arrive meanwhile are due in the next round. One that has much to catch up with
        ends at twice the updates that a quota asks for.
        """
        obs = np.concatenate([segment.obs for segment in segments])
        self._algorithm.observe(torch.from_numpy(obs))
        self._learned_from += len(obs)
        made, update_s = RoundMeans(), math.inf
        while made.count < self._round and self._limiter.may_sample(self._learned_from):
            begin_s = time.monotonic()
            made.add(self._update())
            update_s = min(update_s, time.monotonic() - begin_s)
        if not self._algorithm.is_finite():
            raise A2SError(f"update {self._updates}: found non-finite weights, expected finite")
        means: dict[str, float] = {}
        if made.count:
            self._update_s = update_s
            means = made.means()
            self._metrics.show_off_policy(means, made.count)
        self._show()
        own = {
            "gradient_steps": made.count,
            "replay_rows": len(self._replay),
            "samples_per_insert_error": self._limiter.error,
        }
        return Outcome(dict.fromkeys(SHOWN) | own | means)

    def state(self) -> Saved:
        """Of the algorithm, the limiter and the draws; the replay keeps itself, on the disk."""
        state = (
            self._algorithm.state(),
            {
                "updates": self._updates,
                "learned_from": self._learned_from,
                "limiter": self._limiter.state(),
                "highest_priority": self._replay.highest_priority,
                "rng": self._rng.bit_generator.state,
            },
        )
        self._replay.flush()
        return state

    def serve(self, bus: Bus, keys: Keys, generation: int) -> None:
        """Let others sample the replay."""
        ServedReplay(bus, keys, self._replay, generation).open()

    def close(self) -> None:
        """Close the replay."""
        self._replay.close()

    @property
    def _round(self) -> int:
        """Updates of a round at most."""
        return 2 * math.ceil(self._quota_steps * self._hyper.updates_per_step)

    def _go_on(self, scalars: dict[str, Any]) -> None:
        self._updates, self._learned_from = scalars["updates"], scalars["learned_from"]
        self._limiter.load(scalars["limiter"], self._replay.live.stop)
        self._replay.highest_priority = scalars["highest_priority"]
        self._shown_waits = self._waits()
        self._rng.bit_generator.state = scalars["rng"]

    def _observe_replay(self) -> None:
        """Take into account what no batch brought before a kill."""
        obs = self._replay.obs_since(self._learned_from)
        if len(obs):
            self._algorithm.observe(torch.from_numpy(obs))
        self._learned_from = self._replay.live.stop

    def _update(self) -> OffPolicyStats:
        if wants_returns(self._hyper, self._updates):
            self._algorithm.observe_returns(draw_returns(self._replay, self._hyper, self._rng))
        batch, rows = draw(self._replay, self._hyper, self._rng)
        stats = self._learn_from(batch)
        if self._hyper.prioritised:
            self._replay.update_priorities(rows, stats.error.cpu().numpy())
        self._limiter.count_sample()
        self._updates += 1
        return stats

    def _waits(self) -> dict[str, int]:
        return {"insert": self._limiter.insert_waits, "sample": self._limiter.sample_waits}

    def _show(self) -> None:
        metrics, limiter = self._metrics, self._limiter
        metrics.replay_rows.set(len(self._replay))
        metrics.limiter_error.set(limiter.error)
        waits = self._waits()
        for side, count in waits.items():
            metrics.limiter_waits.labels(side=side).inc(count - self._shown_waits.get(side, 0))
        self._shown_waits = waits


def _open(
    path: Path,
    env_id: str,
    spaces: Spaces,
    hyper: OffPolicyHyper,
    ledger: Ledger,
    least_rows: int,
) -> Replay:
    """Open the replay that is there, given the wanted capacity; else make one."""
    sizes = {"capacity": hyper.replay_rows, "batch_size": hyper.batch_rows}
    alpha = hyper.priority_exponent
    if not (path / files.NAME).exists():
        if least_rows:
            logger.warning("replay %s: is not there any more, another is begun", path)
        return directory.create(path, env_id, spaces, alpha=alpha, **sizes)
    return directory.open_existing(
        path,
        env_id=env_id,
        spaces=spaces,
        is_known=ledger.knows,
        least_rows=least_rows,
        alpha=alpha,
        **sizes,
    )
