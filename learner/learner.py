"""The learner's loop: gather, update, recover, publish, record, checkpoint."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from a2s.learner.export.metadata import policy_metadata
from a2s.learner.ingest.admission import Terms
from a2s.learner.ingest.ingest import Gather
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.server import Service
from a2s.learner.ingest.weights import Publisher
from a2s.learner.run import checkpoint
from a2s.learner.run.config import Configuration
from a2s.learner.run.directory import RunDirectory, column_of, write_summary
from a2s.learner.run.episode_stats import EpisodeRecord
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import View
from a2s.learner.run.status import Report, Standing, summarise
from a2s.learner.run.variants import make_learning
from a2s.learner.trainer import Outcome
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.messages import RecoveryEvent, Segment
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

POSITION = ("update", "wall_s", "env_steps", "weights_version", "epoch")


class Learner:
    """One learner of one run.

    Args:
        configuration: Of the run.
        spaces: Of its environment.
        layout: Names and sizes of the parts of an observation, in the order of its numbers.
        bus: A connection on which actors find it.
        path: Directory of the run.
        metrics: What it shows.
        view: Where its progress is shown.
        resume: Go on from the newest checkpoint in ``path``.

    Raises:
        RunDirectoryError: ``path`` cannot be written, or resumed.
    """

    def __init__(
        self,
        *,
        configuration: Configuration,
        spaces: Spaces,
        layout: Sequence[tuple[str, int]],
        bus: Bus,
        path: Path,
        metrics: LearnerMetrics,
        view: View,
        resume: bool,
    ) -> None:
        self._run = configuration.run
        self._metrics, self._view = metrics, view
        self._at = Standing()
        self._kind = f"{self._run.variant} on {self._run.env}"
        saved, state = None, None
        if resume:
            tensors, state = checkpoint.load(path / "checkpoints", kind=self._kind)
            saved = tensors, state["algorithm"]
            offset = state.get("obs_offset")
            kept = None if offset is None else np.array(offset, dtype=np.float32)
            spaces = replace(spaces, obs_offset=kept)
        self._offset = spaces.obs_offset
        self._metadata = policy_metadata(self._run, spaces, layout)
        self._metric_names = self._run.env_config().metric_names
        self._ledger = Ledger(path / "segments.log")
        self._learning = make_learning(configuration, spaces, path, self._ledger, metrics, saved)
        columns = (*POSITION, *self._learning.columns)
        self._directory = RunDirectory(path, columns, self._at.wall_s)
        self._plays_on = self._run.clock == "lockstep" and self._learning.plays_on
        self._first_version = 0
        self._updates_before = 0
        self._record = EpisodeRecord()
        self._latest = b""
        self._bus = bus
        if state is not None:
            self._go_on(state)
        else:
            self._save()
        self._at.generation = self._directory.count_start()
        self._at.steps_at_start = self._at.env_steps = self._ledger.accepted_steps
        metrics.env_steps.inc(self._at.env_steps)
        self._keys = keys = Keys(self._run.run)
        terms = Terms(
            run=self._run.run,
            generation=self._at.generation,
            env_id=self._run.env,
            spaces=spaces,
            num_envs=self._run.envs,
            clock=self._run.clock,
            max_policy_lag=self._learning.max_policy_lag,
            most_suggested=self._learning.most_suggested,
            seed=self._run.seed,
            num_actors=self._run.n,
            env=self._run.env_config(),
        )
        self._gather = Gather(
            terms,
            self._ledger,
            metrics,
            self._directory.event,
            self._learning.keep,
            self._learning.hold_s,
        )
        self._publisher = Publisher(bus, keys)
        self._report = Report(self._run, self._at, self._record, self._gather)
        self._service = Service(bus, keys, self._gather, self._report.status)

    def run(self, stopped: Callable[[], bool]) -> dict[str, Any]:
        """Learn until ``total_steps``, or until stopped.

        Returns:
            The summary, as in ``summary.json``.
        """
        self._metrics.target_steps.set(self._run.total_steps)
        self._metrics.generation.set(self._at.generation)
        self._directory.event("start", generation=self._at.generation, env_steps=self._at.env_steps)
        self._learning.serve(self._bus, self._keys, self._at.generation)
        self._service.open()

        def proceed(waiting_for: str) -> bool:
            self._at.waiting_for = waiting_for
            self._show()
            return not stopped()

        self._publish()
        while self._at.env_steps < self._run.total_steps and not stopped():
            batch = self._next_batch(proceed)
            if not batch:
                break
            segments = [segment for _, segment in batch]
            self._keep_best()
            if self._plays_on:
                self._publish()
            outcome = self._learn(segments)
            self._recover(outcome, proceed)
            if not self._plays_on or outcome.recovered:
                self._publish()
            self._write(outcome)
            if self._passed(self._run.checkpoint_every_updates):
                self._checkpoint()
            if self._passed(self._run.keep_policy_every_updates):
                self._directory.policy(f"policies/{self._at.env_steps:09d}", self._to_keep())
        self._at.version = max(self._at.version, self._first_version)
        self._bus.close()
        self._count(self._gather.take())
        self._checkpoint()
        return self._finish()

    def _next_batch(self, proceed: Callable[[str], bool]) -> list[tuple[int, Segment]]:
        begin_s = time.monotonic()
        batch = self._gather.next_batch(proceed)
        self._metrics.starved.inc(time.monotonic() - begin_s)
        self._at.waiting_for = ""
        self._count(batch)
        return batch

    def _count(self, batch: list[tuple[int, Segment]]) -> None:
        """Add up steps and episodes: of a batch, and of what came too late to be one."""
        for slot, segment in batch:
            self._at.env_steps += segment.num_steps
            if segment.ends_episode:
                metrics = {
                    column_of(m.name): m.value
                    for m in segment.metrics
                    if m.name in self._metric_names
                }
                self._record.add(segment.episode_return, segment.episode_length, metrics)
                self._metrics.episodes.inc()
                self._directory.episode(
                    metrics,
                    **{
                        "env_steps": self._at.env_steps,
                        "actor": slot,
                        "weights_version": segment.weights_version,
                        "return": f"{segment.episode_return:.9g}",
                        "length": segment.episode_length,
                        "terminated": int(segment.terminated),
                    },
                )

    def _learn(self, segments: list[Segment]) -> Outcome:
        made_by = max(segment.weights_version for segment in segments)
        is_behind = made_by < self._first_version
        with self._metrics.update_seconds.labels(phase="compute").time():
            outcome = self._learning.learn(segments, self._progress(), is_behind=is_behind)
        self._updates_before, self._at.updates = self._at.updates, self._learning.updates
        self._first_version = self._at.version + 1
        return outcome

    def _progress(self) -> float:
        """Fraction of the run that is done, 0..1."""
        return min(1.0, self._at.env_steps / self._run.total_steps)

    def _keep_best(self) -> None:
        """Keep the policy, if the returns of the newest episodes are the best so far."""
        recent = self._record.recent_return
        if recent is None or (self._at.best_recent is not None and recent <= self._at.best_recent):
            return
        self._at.best_recent = recent
        self._directory.policy("best", self._to_keep())

    def _passed(self, every: int) -> bool:
        """Whether the latest updates passed a multiple; never that of 0."""
        return every > 0 and self._at.updates // every > self._updates_before // every

    def _recover(self, outcome: Outcome, proceed: Callable[[str], bool]) -> None:
        """Broadcast and write down a recovery; the restored networks are published next.

        What is being played meanwhile is waited for, though not learned from: environments are at
        the same step in every run then.
        """
        if not outcome.recovered:
            return
        self._at.epoch += 1
        decision = outcome.decision
        assert decision is not None
        event = RecoveryEvent(
            id=self._at.epoch,
            generation=self._at.generation,
            epoch=self._at.epoch,
            draw=decision.draw,
            probability=decision.probability,
            r=_number(decision.r),
            r_best=_number(decision.r_best),
            restored_version=outcome.restored_version,
            weights_version=self._at.version + 1,
        )
        self._directory.event("recovery", **asdict(event))
        self._service.announce_recovery(event)
        self._metrics.recoveries.inc()
        if self._plays_on and self._at.env_steps < self._run.total_steps:
            self._next_batch(proceed)

    def _export(self, version: int, *, to_keep: bool = False) -> bytes:
        return self._learning.graph(version, self._progress(), self._metadata, to_keep=to_keep)

    def _to_keep(self) -> bytes:
        return self._export(max(self._at.version, self._first_version), to_keep=True)

    def _publish(self) -> None:
        """Export the networks; while the run goes on, serve and announce them."""
        version = self._at.version + 1
        with self._metrics.update_seconds.labels(phase="publish").time():
            graph = self._export(version)
            if self._at.env_steps < self._run.total_steps:
                quota = self._learning.quota(self._gather.num_envs)
                notice = self._publisher.prepare(
                    graph,
                    generation=self._at.generation,
                    epoch=self._at.epoch,
                    version=version,
                    quota=(quota.steps, quota.episodes),
                )
                self._gather.publish(notice, quota.batch_steps)
                self._publisher.announce()
        self._at.version = version
        self._metrics.published.inc()
        self._metrics.weights_version.set(self._at.version)
        self._metrics.weights_bytes.set(len(graph))
        self._metrics.epoch.set(self._at.epoch)

    def _write(self, outcome: Outcome) -> None:
        record = self._record
        self._metrics.show_episodes(record.returns, record.lengths, record.mean_metrics)
        position = (
            self._learning.updates, round(self._at.wall_s(), 3), self._at.env_steps,
            self._at.version, self._at.epoch,
        )  # fmt: skip
        self._directory.update({**outcome.row, **dict(zip(POSITION, position, strict=True))})
        self._at.rows += 1
        self._show(outcome.kl)

    def _checkpoint(self) -> None:
        try:
            self._save()
        except RunDirectoryError as error:
            self._metrics.checkpoint_failures.inc()
            logger.warning("%s; going on without it", error)  # the next one may succeed

    def _save(self) -> None:
        self._latest = self._to_keep()
        self._directory.policy("latest", self._latest)
        tensors, scalars = self._learning.state()
        state = {
            "algorithm": scalars,
            "rows": self._at.rows,
            "version": self._at.version,
            "epoch": self._at.epoch,
            "best_recent": self._at.best_recent,
            "wall_s": self._at.wall_s(),
            "obs_offset": None if self._offset is None else self._offset.tolist(),
        }
        with self._metrics.checkpoint_seconds.time():
            folder, updates = self._directory.path / "checkpoints", self._learning.updates
            _, size = checkpoint.save(folder, updates, tensors, state, kind=self._kind)
        self._metrics.checkpoint_time.set_to_current_time()
        self._metrics.checkpoint_bytes.set(size)

    def _go_on(self, state: dict[str, Any]) -> None:
        self._at.version, self._at.epoch = state["version"], state["epoch"]
        self._at.best_recent, self._at.worked_s = state["best_recent"], state["wall_s"]
        self._at.updates = self._learning.updates
        self._at.rows = state["rows"]
        for wall_s, episode_return, length, metrics in self._directory.read_episodes():
            self._record.add(episode_return, length, metrics)
            self._at.worked_s = max(self._at.worked_s, wall_s)
        self._directory.keep_updates(self._at.rows)

    def _finish(self) -> dict[str, Any]:
        summary = summarise(
            self._run,
            self._at,
            self._record,
            self._gather.accounts(),
            self._directory.path,
            self._latest,
            self._gather.dropped_steps,
        )
        self._directory.event("end", env_steps=self._at.env_steps)
        write_summary(self._directory.path, summary)
        self._directory.close()
        self._ledger.close()
        self._learning.close()
        return summary

    def _show(self, kl: float | None = None) -> None:
        progress = self._report.progress(kl)
        self._metrics.actors.set(progress.actors)
        self._metrics.queue.set(self._gather.pending_steps())
        self._view.show(progress)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
