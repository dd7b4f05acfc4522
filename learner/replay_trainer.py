"""A learner that plays nothing: it learns off-policy from what another run keeps or serves."""

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from a2s.learner.export.metadata import policy_metadata
from a2s.learner.export.off_policy import export
from a2s.learner.ingest.batching import Source, draw, draw_returns, wants_returns
from a2s.learner.ingest.ledger import Accounts
from a2s.learner.ingest.off_policy_row import SHOWN, RoundMeans
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.recorded_update import update_of
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run import checkpoint
from a2s.learner.run.config import Configuration
from a2s.learner.run.directory import RunDirectory, write_summary
from a2s.learner.run.episode_stats import EpisodeRecord
from a2s.learner.run.memory import keep_freed_memory
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.status import Standing, summarise
from a2s.protocol.codec import MAX_BYTES, MIB
from a2s.protocol.errors import A2SError, UnreachableError, UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.replay_messages import MAX_SAMPLED, ReplaySample

logger = logging.getLogger(__name__)

COLUMNS = ("update", "wall_s", "env_steps", "weights_version", "epoch", "replay_rows", *SHOWN)
_ROUND = 100
_BATCH, _RETURNS, _STATISTICS = 1, 2, 3
_ANSWER_BYTES = MAX_BYTES[ReplaySample] - MIB  # the rest is for what is not rows
_ASK_AGAIN_S = 1.0
_PATIENCE_S = 10.0


class FromReplay:
    """Makes the updates that ``total_steps`` environment steps are worth, from another's replay.

    Nothing is changed there: priorities are the other learner's own.

    Args:
        configuration: Of this run; its variant is off-policy.
        spaces: Of the environment of the replay.
        source: The replay.
        size: Asks how many transitions it holds now.
        most: How many it comes to hold at most: its capacity, or what is stored.
        path: Directory of this run.
        metrics: Where updates are shown.
        resume: Go on from the newest checkpoint in ``path``.

    Raises:
        UsageError: The replay never holds as much as a batch.
        RunDirectoryError: ``path`` cannot be written, or resumed.
    """

    def __init__(
        self,
        *,
        configuration: Configuration,
        spaces: Spaces,
        source: Source,
        size: Callable[[], int],
        most: int,
        path: Path,
        metrics: LearnerMetrics,
        resume: bool,
    ) -> None:
        hyper = configuration.hyper
        assert isinstance(hyper, OffPolicyConfig)
        self._run, self._hyper = configuration.run, hyper
        self._metadata = policy_metadata(self._run, spaces)
        if most < hyper.batch_rows:
            raise UsageError(
                f"replay: found {most} transitions at most, expected a batch of "
                f"{hyper.batch_rows}; set batch_rows, or name another replay"
            )
        self._wanted = min(max(hyper.warm_up_steps, hyper.batch_rows), most)
        self._source, self._size, self._metrics = source, size, metrics
        torch.set_num_threads(self._run.threads)
        keep_freed_memory()
        row_bytes = 8 * (spaces.obs_size + spaces.action_size + 3)
        self._statistics_rows = min(MAX_SAMPLED, _ANSWER_BYTES // row_bytes)
        self._bounds = torch.tensor(spaces.action_low), torch.tensor(spaces.action_high)
        seed = self._run.seed
        device = self._run.device
        self._algorithm = OffPolicy(spaces.obs_size, spaces.action_size, hyper, seed, device)
        self._learn_from = update_of(self._algorithm)
        self._at = Standing()
        self._kind = f"off-policy on {self._run.env} from a replay"
        saved = checkpoint.load(path / "checkpoints", kind=self._kind) if resume else None
        self._directory = RunDirectory(path, COLUMNS, self._at.wall_s)
        if saved is not None:
            self._go_on(*saved)
        else:
            self._save()
        self._at.generation = self._directory.count_start()
        self._at.steps_at_start = self._at.env_steps

    def run(self, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Learn until the updates are made, or until stopped.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            UnreachableError: The replay is gone; what was learned is in the checkpoint.
            A2SError: The networks are no longer finite; the checkpoint is the one before.
        """
        self._directory.event("start", generation=self._at.generation, env_steps=self._at.env_steps)
        self._metrics.target_steps.set(self._run.total_steps)
        with closing(self._directory):
            try:
                if self._is_filled(stopped):
                    with ThreadPoolExecutor(1, thread_name_prefix="replay") as ahead:
                        self._learn(ahead, stopped)
            except UnreachableError as error:
                raise UnreachableError(f"{error} Go on with --resume when it is there") from None
            finally:
                if self._algorithm.is_finite():
                    self._checkpoint()
            return self._finish()

    def _is_filled(self, stopped: Callable[[], bool]) -> bool:
        """Wait until there is as much as a learner with actors would wait for, or all there is."""
        said_s = time.monotonic()
        while (found := self._size()) < self._wanted:
            if stopped():
                return False
            if time.monotonic() - said_s >= _PATIENCE_S:
                said_s = time.monotonic()
                logger.warning("waiting for %d transitions, the replay has %d", self._wanted, found)
            time.sleep(_ASK_AGAIN_S)
        return True

    def _learn(self, ahead: ThreadPoolExecutor, stopped: Callable[[], bool]) -> None:
        """Update round by round; the next batch is fetched while one is learned from."""
        if self._at.updates == 0:
            drawn = self._source.sample(self._statistics_rows, self._generator(_STATISTICS, 0))
            self._algorithm.observe(torch.from_numpy(drawn.obs))
        coming = ahead.submit(self._draw, self._at.updates)
        while self._at.env_steps < self._run.total_steps and not stopped():
            made = RoundMeans()
            for update in range(self._at.updates, self._at.updates + _ROUND):
                if wants_returns(self._hyper, update):
                    rng = self._generator(_RETURNS, update)
                    returns = ahead.submit(draw_returns, self._source, self._hyper, rng)
                    self._algorithm.observe_returns(returns.result())
                batch, coming = coming.result(), ahead.submit(self._draw, update + 1)
                made.add(self._learn_from(batch))
            self._stand_at(self._at.updates + _ROUND)
            self._algorithm.observe(batch.obs)
            if not self._algorithm.is_finite():
                raise A2SError(
                    f"update {self._at.updates}: found non-finite weights, expected finite"
                )
            self._write(made.means())
        coming.exception()  # nobody needs this batch any more; whether it came does not matter

    def _draw(self, update: int) -> Transitions:
        batch, _ = draw(self._source, self._hyper, self._generator(_BATCH, update))
        return batch

    def _generator(self, use: int, update: int) -> np.random.Generator:
        """Make that of one draw, so that a batch drawn ahead of a checkpoint is drawn again."""
        return np.random.default_rng([self._run.seed, use, update])

    def _stand_at(self, updates: int) -> None:
        """Count updates, and the environment steps that they are worth."""
        self._at.updates = updates
        self._at.env_steps = int(updates / self._hyper.utd_ratio)

    def _write(self, means: Mapping[str, float]) -> None:
        size = self._size()
        self._metrics.show_off_policy(means, _ROUND)
        self._metrics.replay_rows.set(size)
        position = (
            self._at.updates,
            round(self._at.wall_s(), 3),
            self._at.env_steps,
            self._at.updates,
            0,
        )
        self._directory.update(
            {**dict(zip(COLUMNS, position, strict=False)), "replay_rows": size, **means}
        )
        self._at.rows += 1
        if self._at.updates % self._run.checkpoint_every_updates < _ROUND:
            self._checkpoint()

    def _graph(self) -> bytes:
        warms_up = self._at.updates == 0
        suggester = self._algorithm.suggester(*self._bounds, warms_up=warms_up, averaged=True)
        return export(suggester, self._at.updates, self._metadata)

    def _checkpoint(self) -> None:
        self._directory.policy("latest", self._graph())
        self._save()

    def _save(self) -> None:
        state = {
            "updates": self._at.updates,
            "rows": self._at.rows,
            "wall_s": self._at.wall_s(),
        }
        folder = self._directory.path / "checkpoints"
        checkpoint.save(folder, self._at.updates, self._algorithm.state(), state, kind=self._kind)

    def _go_on(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
        self._algorithm.load(tensors)
        self._stand_at(state["updates"])
        self._at.rows, self._at.worked_s = state["rows"], state["wall_s"]
        self._directory.keep_updates(self._at.rows)

    def _finish(self) -> dict[str, Any]:
        none = Accounts(sent=0, accepted=0, duplicate=0, stale=0, refused=0, lost=0)
        path = self._directory.path
        summary = summarise(self._run, self._at, EpisodeRecord(), none, path, self._graph())
        self._directory.event("end", env_steps=self._at.env_steps)
        write_summary(self._directory.path, summary)
        return summary
