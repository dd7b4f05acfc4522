"""The progress that a run has made."""

import hashlib
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from a2s.learner.feed import Attendance
from a2s.learner.ingest.members import Member
from a2s.learner.run.episode_stats import EpisodeStats
from a2s.learner.run.limits import Limits
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.messages import RunStatus

_AGAIN = "what came since the checkpoint, from which it learns again"
POSITION = ("update", "wall_s", "env_steps", "weights_version", "epoch")


class Score(NamedTuple):
    """What an evaluation found: returns of the mean action."""

    env_steps: int
    mean: float
    std: float


@dataclass(slots=True)
class Status:
    """The progress of the learner's loop.

    Attributes:
        episodes: Finished ones.
        generation: Of this start of the learner, as on the wire.
        env_steps: Environment steps learned from, those of earlier starts included.
        steps_at_start: The same, when this learner started.
        updates: Batches learned from; off-policy gradient steps.
        rows: Rows of ``updates.csv``.
        version: Newest weights that were published.
        acting: Their graph.
        is_ahead: The networks have learned since then, and are of the version after it.
        num_recoveries: Called ``epoch`` on the wire.
        best_recent: Best mean return of 10 episodes in a row; ``None`` before the first.
        latest_score: Of the newest evaluation while training; ``None`` before the first.
        best_score: Of the best one.
        waiting_for: What the loop waits for; empty while it learns.
        learns_again: It learns from what came since the checkpoint before it was killed.
        learning_s: Seconds since this learner started in which it did not wait for a batch.
        limits: What the seconds of learner and actors go into.
        worked_s: Seconds that earlier starts took.
        began_s: When this learner started, on the monotonic clock.
    """

    run: RunConfig
    episodes: EpisodeStats = field(default_factory=EpisodeStats)
    generation: int = 0
    env_steps: int = 0
    steps_at_start: int = 0
    updates: int = 0
    rows: int = 0
    version: int = 0
    acting: bytes = b""
    is_ahead: bool = False
    num_recoveries: int = 0
    best_recent: float | None = None
    latest_score: Score | None = None
    best_score: Score | None = None
    waiting_for: str = ""
    learns_again: bool = False
    learning_s: float = 0.0
    limits: Limits = field(default_factory=Limits)
    worked_s: float = 0.0
    began_s: float = field(default_factory=time.monotonic)

    @property
    def networks_version(self) -> int:
        """Version of the present networks, whether they were published yet or not."""
        return self.version + self.is_ahead

    @property
    def is_finished(self) -> bool:
        """Whether all steps were played, or an evaluation was as good as was wanted."""
        return self.env_steps >= self.run.total_steps or self.is_good

    @property
    def is_good(self) -> bool:
        """Whether an evaluation was as good as was wanted."""
        return self.best_score is not None and self.best_score.mean >= self.run.stop_at_return

    @property
    def ended(self) -> str:
        """Why the run is at its end; empty: it is not."""
        if self.is_good:
            return "an evaluation was good enough"
        return "all steps are made" if self.is_finished else ""

    @property
    def fraction(self) -> float:
        """Fraction of the run that is done, 0..1."""
        return min(1.0, self.env_steps / self.run.total_steps)

    @property
    def wall_s(self) -> float:
        """Seconds of the run so far."""
        return self.worked_s + time.monotonic() - self.began_s

    @property
    def env_steps_per_s(self) -> float:
        """Steps per second since this learner started."""
        seconds = max(time.monotonic() - self.began_s, 1e-9)
        return (self.env_steps - self.steps_at_start) / seconds

    def evaluated(self, score: Score) -> bool:
        """Take an evaluation into account; tells whether it is the best so far."""
        self.latest_score = score
        if self.best_score is not None and score.mean <= self.best_score.mean:
            return False
        self.best_score = score
        return True

    def position(self) -> dict[str, object]:
        """For a row of ``updates.csv``, by `POSITION`."""
        wall_s, version = round(self.wall_s, 3), self.version
        position = self.updates, wall_s, self.env_steps, version, self.num_recoveries
        return dict(zip(POSITION, position, strict=True))

    def message(self, members: Sequence[Member]) -> RunStatus:
        """The answer to requests over the network."""
        mean = self.episodes.mean_return
        return RunStatus(
            run=self.run.run,
            generation=self.generation,
            env_id=self.run.env,
            env_steps=self.env_steps,
            total_steps=self.run.total_steps,
            episodes=self.episodes.count,
            updates=self.updates,
            weights_version=self.version,
            epoch=self.num_recoveries,
            return_mean=math.nan if mean is None else mean,
            env_steps_per_s=self.env_steps_per_s,
            waiting_for=_AGAIN if self.learns_again else self.waiting_for,
            actors=tuple(m.status for m in members if m.status is not None),
            learning_s=self.learning_s,
            limited_by=self.limits.shares.largest if self.limits.shares else "",
            unix_s=time.time(),
            evaluation_return=self.latest_score.mean if self.latest_score else 0.0,
            evaluation_steps=self.latest_score.env_steps if self.latest_score else 0,
            variant=self.run.variant,
            ended=self.ended,
        )

    def summary(self, attendance: Attendance, graph: bytes) -> dict[str, Any]:
        """For ``summary.json`` and ``--json``; ``graph`` is the final policy."""
        return {
            "env": self.run.env,
            "variant": self.run.variant,
            "algo": self.run.algo,
            "preset": self.run.preset,
            "seed": self.run.seed,
            "env_steps": self.env_steps,
            "episodes": self.episodes.count,
            "updates": self.updates,
            "wall_s": round(self.wall_s, 3),
            "env_steps_per_s": round(self.env_steps_per_s, 1),
            "return_mean_last_10": self.episodes.recent_return,
            "return_best": self.episodes.best,
            "evaluation_best": None if self.best_score is None else self.best_score._asdict(),
            "recoveries": self.num_recoveries,
            "segments": asdict(attendance.accounts),
            "dropped_transitions": attendance.dropped_steps,
            "info_metrics": self.episodes.mean_metrics,
            "weights_sha256": hashlib.sha256(graph).hexdigest(),
            "finished": self.is_finished,
            "stopped_at_return": self.is_good,
        }
