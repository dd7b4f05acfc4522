"""The learner's loop: wait for a batch, learn, recover, publish, record, checkpoint."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from a2s.learner.feed import Arrival, Feed
from a2s.learner.ingest.clock import clock_of
from a2s.learner.ingest.evaluations import Evaluations
from a2s.learner.ingest.journal import Journal
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.members import Member
from a2s.learner.run.directory import RunDirectory, write_summary
from a2s.learner.run.episode_log import EpisodeLog
from a2s.learner.run.evaluating import Evaluating
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import View
from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.saver import Saver
from a2s.learner.run.status import POSITION, Status
from a2s.learner.run.tensorboard import Board
from a2s.learner.trainer import Outcome, Saved, Trainer
from a2s.protocol.errors import UnreachableError
from a2s.protocol.fields import Spaces
from a2s.protocol.generations import numbered, start_of
from a2s.protocol.messages import RecoveryEvent

_EVALUATION_WAIT_S = 1.0
_EVALUATIONS = "evaluations by `a2s actor --evaluate`"


class Learner:
    """One learner of one run; `make.make_learner` and `make.make_replay_learner` make it.

    ``mark`` makes its generation unique: 32 random bits, on which nothing depends that is learned.
    ``connect`` makes the feed of a generation and is given the handler of events; ``evaluations``
    are the feed's. ``past`` gives the batches since the checkpoint, from the ``journal``.
    ``env_steps`` are those of earlier starts. ``kind`` names the kind of run; checkpoints of
    another kind are refused. ``saved`` is a checkpoint to go on from. The trainer is closed at the
    end.

    Raises:
        RunDirectoryError: ``path`` cannot be written, or has changed since it was saved.
    """

    def __init__(
        self,
        *,
        run: RunConfig,
        trainer: Trainer,
        mark: int,
        connect: Callable[[int, Callable[..., None]], Feed],
        evaluations: Evaluations,
        past: Feed | None = None,
        journal: Journal | None = None,
        ledger: Ledger | None = None,
        env_steps: int,
        path: Path,
        kind: str,
        spaces: Spaces,
        saved: Saved | None,
        metrics: LearnerMetrics,
        view: View,
    ) -> None:
        self._trainer, self._metrics, self._view = trainer, metrics, view
        self._status = status = Status(run)
        columns = (*POSITION, *trainer.columns)
        self._directory = directory = RunDirectory(path, columns, lambda: status.wall_s)
        self._saver = Saver(
            trainer, status, directory, metrics, kind, spaces.obs_offset, journal, ledger
        )  # fmt: skip
        if saved is None:
            self._saver.save()
        else:
            self._saver.go_on(saved[1], again=past is not None)
        names = run.env_config().metric_names
        self._episodes = EpisodeLog(status.episodes, directory, metrics, names)
        self._evaluating = Evaluating(evaluations, directory, metrics, status)
        self._board = (
            Board(path, run.variant, env_steps, self._evaluating.earlier)
            if run.tensorboard
            else None
        )
        status.generation = numbered(directory.count_start(), mark)
        status.env_steps = status.steps_at_start = env_steps
        self._feed, self._past = connect(status.generation, directory.event), past
        self._overlaps = trainer.overlaps_learning and clock_of(run.clock).waits_for_weights

    @property
    def done(self) -> str:
        """Why there is nothing to do; empty: there is."""
        option = "a higher --stop-at-return" if self._status.is_good else "--total-steps"
        return f"{self._status.ended}; {option} for more" if self._status.ended else ""

    def run(self, stopped: Callable[[], bool], *, only_again: bool = False) -> dict[str, Any]:
        """Learn until ``total_steps``, or until stopped; or ``only_again`` what is in the journal.

        Returns:
            The summary, as in ``summary.json``.

        Raises:
            UnreachableError: Another run's replay is gone; what was learned is in the checkpoint.
            A2SError: The networks are no longer finite, or the run cannot be stored.
        """

        def proceed(waiting_for: str) -> bool:
            self._status.waiting_for = waiting_for
            self._show()
            return not stopped() and not self._status.is_good

        with ExitStack() as stack:
            for part in (self._directory, self._trainer, self._feed, self._board):
                if part is not None:
                    stack.enter_context(closing(part))
            self._start()
            self._feed.tell(lambda: self._status.message(self._feed.attendance().members))
            self._learn_again(proceed)
            try:
                if not only_again and (self._past is None or not stopped()):
                    self._open()
                while not only_again and not self._status.is_finished and not stopped():
                    if not self._step(proceed):
                        break
            except UnreachableError as error:
                self._saver.try_save()
                raise UnreachableError(f"{error} Go on with --resume when it is there") from None
            return self._finish(proceed)

    def _learn_again(self, proceed: Callable[[str], bool]) -> None:
        """Learn from the batches since the checkpoint."""
        if self._past is None:
            return
        status, feed, updates = self._status, self._feed, self._trainer.updates
        self._feed, status.learns_again = self._past, True
        self._begin()
        while not status.is_finished and self._step(proceed):
            pass
        status.learns_again = False
        made, steps = self._trainer.updates - updates, status.env_steps - status.steps_at_start
        if made:
            self._directory.event("again", updates=made, env_steps=steps)
        self._feed, status.steps_at_start = feed, status.env_steps

    def _step(self, proceed: Callable[[str], bool]) -> bool:
        """Learn from one batch; false if the wait for it was ended."""
        if not self._wait_for_batch(proceed):
            return False
        begin_s = time.monotonic()
        if not self._status.run.evaluate_every:
            self._saver.keep_best()
        if self._overlaps:
            self._publish()
        outcome = self._learn()
        if outcome.recovered:
            self._recover(outcome, proceed)
        if outcome.recovered or not self._overlaps:
            self._publish()
        self._record(outcome)
        self._status.learning_s += time.monotonic() - begin_s
        return True

    def _wait_for_batch(self, proceed: Callable[[str], bool]) -> bool:
        begin_s = time.monotonic()
        arrivals = self._feed.next_batch(proceed)
        self._metrics.starved.inc(time.monotonic() - begin_s)
        self._status.waiting_for = ""
        self._count(arrivals)
        return bool(arrivals)

    def _count(self, arrivals: Sequence[Arrival]) -> None:
        for arrival in arrivals:
            self._status.env_steps += arrival.num_steps
            if arrival.episode is not None:
                self._episodes.add(arrival.episode, arrival.slot, self._status.env_steps)

    def _learn(self) -> Outcome:
        with self._metrics.update_seconds.labels(phase="compute").time():
            outcome = self._trainer.learn(self._status.fraction)
        self._status.is_ahead = True
        return outcome

    def _recover(self, outcome: Outcome, proceed: Callable[[str], bool]) -> None:
        """Broadcast and write down a recovery; the restored networks are published next.

        Steps in play are waited for, though not learned from: so environments are at the same step
        in every run.
        """
        status, decision = self._status, outcome.decision
        assert decision is not None
        status.num_recoveries += 1
        event = RecoveryEvent(
            id=status.num_recoveries,
            generation=status.generation,
            epoch=status.num_recoveries,
            draw=decision.draw,
            probability=decision.probability,
            r=math.nan if decision.r is None else decision.r,
            r_best=math.nan if decision.r_best is None else decision.r_best,
            restored_version=outcome.restored_version,
            weights_version=status.networks_version,
        )
        told = asdict(event) | {"generation": start_of(status.generation)}
        self._directory.event("recovery", **told)
        self._feed.announce_recovery(event)
        self._metrics.recoveries.inc()
        if self._overlaps and not status.is_finished:
            self._wait_for_batch(proceed)

    def _begin(self) -> None:
        """Give actors what they played last, or the first networks."""
        status, acting = self._status, self._status.acting
        if status.version == 0:
            self._publish()
        elif status.is_ahead and not status.is_finished:
            self._feed.publish(lambda _: acting, status.version, status.num_recoveries)
        elif not status.is_finished:
            self._give(status.version)

    def _publish(self) -> None:
        """Give the networks to the actors unless the run is at its end."""
        self._give(self._feed.next_version(self._status.version))

    def _give(self, version: int) -> None:
        status = self._status

        def graph(version: int) -> bytes:
            status.acting = self._trainer.graph(version, status.fraction)
            return status.acting

        if not status.is_finished:
            with self._metrics.update_seconds.labels(phase="publish").time():
                self._feed.publish(graph, version, status.num_recoveries)
        status.version, status.is_ahead = version, False
        self._metrics.published.inc()
        self._metrics.weights_version.set(version)
        self._metrics.epoch.set(status.num_recoveries)

    def _record(self, outcome: Outcome) -> None:
        """Write a row, and save what is due."""
        status, run = self._status, self._status.run
        before, status.updates = status.updates, self._trainer.updates
        self._directory.update({**outcome.row, **status.position()})
        status.rows += 1
        self._metrics.show_episodes(status.episodes)
        self._show(outcome.kl)
        self._evaluating.want(partial(self._trainer.graph, averaged=True))
        if self._board is not None:
            self._board.update(outcome.row, status)

        def passed(every: int) -> bool:
            return every > 0 and status.updates // every > before // every

        if passed(run.checkpoint_every_updates):
            self._saver.try_save()
        if passed(run.keep_policy_every_updates):
            self._saver.keep_policy(f"policies/{status.env_steps:09d}")

    def _start(self) -> None:
        status = self._status
        self._metrics.target_steps.set(status.run.total_steps)
        start = start_of(status.generation)
        self._metrics.generation.set(start)
        self._directory.event("start", generation=start, env_steps=status.env_steps)

    def _open(self) -> None:
        """Have actors come in, and play."""
        self._feed.open()
        self._begin()

    def _finish(self, proceed: Callable[[str], bool]) -> dict[str, Any]:
        begin_s = time.monotonic()
        while self._evaluating.awaits(time.monotonic() - begin_s) and proceed(_EVALUATIONS):
            self._evaluating.look(_EVALUATION_WAIT_S)
        self._feed.stop()
        status, path = self._status, self._directory.path
        if status.is_finished:
            self._count(self._feed.take())
            status.version, status.is_ahead = status.networks_version, False
        self._saver.save()
        reached = status.summary(self._feed.attendance(), self._saver.latest)
        summary = {"run_dir": str(path), **reached}
        self._directory.event("end", env_steps=status.env_steps)
        write_summary(path, summary)
        return summary

    def _show(self, kl: float | None = None) -> None:
        self._evaluating.look()
        attendance = self._feed.attendance()
        self._metrics.show_actors(attendance.members)
        self._metrics.queue.set(attendance.pending_steps)
        self._look_at_limits(attendance.members)
        self._view.show(self._status, attendance.members, kl)

    def _look_at_limits(self, members: Sequence[Member]) -> None:
        limits = self._status.limits
        statuses = (member.status for member in members if member.status is not None)
        if limits.look(time.monotonic(), self._status.learning_s, statuses):
            self._metrics.show_limits(limits.shares)
