"""Where a run stands, and the three ways of saying it: progress, status, summary."""

import hashlib
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from a2s.learner.ingest.ingest import Gather
from a2s.learner.ingest.ledger import Accounts
from a2s.learner.run.config import RunConfig
from a2s.learner.run.episode_stats import EpisodeRecord
from a2s.learner.run.progress import Progress
from a2s.protocol.messages import RunStatus


@dataclass(slots=True)
class Standing:
    """What the learner's loop counts.

    Attributes:
        generation: Which start of the learner this is.
        env_steps: Environment steps learned from, those of earlier starts included.
        steps_at_start: The same, when this learner started.
        updates: Updates made.
        rows: Rows of ``updates.csv``.
        version: Newest weights.
        epoch: Recoveries.
        best_recent: Best mean return of 10 episodes in a row; ``None`` before the first.
        waiting_for: What the loop waits for; empty while it learns.
        worked_s: Seconds that earlier starts took.
        began_s: When this learner started, on the monotonic clock.
    """

    generation: int = 0
    env_steps: int = 0
    steps_at_start: int = 0
    updates: int = 0
    rows: int = 0
    version: int = 0
    epoch: int = 0
    best_recent: float | None = None
    waiting_for: str = ""
    worked_s: float = 0.0
    began_s: float = field(default_factory=time.monotonic)

    def wall_s(self) -> float:
        """Seconds of the run so far."""
        return self.worked_s + time.monotonic() - self.began_s

    def env_steps_per_s(self) -> float:
        """Steps per second since this learner started."""
        seconds = max(time.monotonic() - self.began_s, 1e-9)
        return (self.env_steps - self.steps_at_start) / seconds


class Report:
    """Says where a run stands.

    Args:
        run: Its options.
        at: Where it stands.
        record: Its episodes.
        gather: Its actors and accounts.
    """

    def __init__(self, run: RunConfig, at: Standing, record: EpisodeRecord, gather: Gather) -> None:
        self._run, self._at, self._record, self._gather = run, at, record, gather

    def progress(self, kl: float | None) -> Progress:
        """For the terminal; ``kl`` is that of the latest update."""
        members = self._gather.members()
        return Progress(
            env_steps=self._at.env_steps,
            total_steps=self._run.total_steps,
            episodes=self._record.count,
            return_mean=self._record.mean_return,
            return_best=self._record.best,
            updates=self._at.updates,
            weights_version=self._at.version,
            recoveries=self._at.epoch,
            actors=len(members),
            num_envs=sum(member.num_envs for member in members),
            waiting_for=self._at.waiting_for,
            wall_s=self._at.wall_s(),
            kl=kl,
            info=self._record.mean_metrics,
        )

    def status(self) -> RunStatus:
        """For whoever asks over the network."""
        mean = self._record.mean_return
        return RunStatus(
            run=self._run.run,
            generation=self._at.generation,
            env_id=self._run.env,
            env_steps=self._at.env_steps,
            total_steps=self._run.total_steps,
            episodes=self._record.count,
            updates=self._at.updates,
            weights_version=self._at.version,
            epoch=self._at.epoch,
            return_mean=math.nan if mean is None else mean,
            env_steps_per_s=self._at.env_steps_per_s(),
            waiting_for=self._at.waiting_for,
            actors=tuple(m.status for m in self._gather.members() if m.status is not None),
        )


def summarise(
    run: RunConfig,
    at: Standing,
    record: EpisodeRecord,
    accounts: Accounts,
    path: Path,
    graph: bytes,
    dropped_steps: int = 0,
) -> dict[str, Any]:
    """For ``summary.json`` and ``--json``.

    Args:
        run: The options of the run.
        at: Where it stands.
        record: Its episodes.
        accounts: Its segments.
        path: Its directory.
        graph: The final weights.
        dropped_steps: Steps whose numbers could not be used, as actors told.
    """
    return {
        "run_dir": str(path),
        "env": run.env,
        "variant": run.variant,
        "algo": run.algo,
        "preset": run.preset,
        "seed": run.seed,
        "env_steps": at.env_steps,
        "episodes": record.count,
        "updates": at.updates,
        "wall_s": round(at.wall_s(), 3),
        "env_steps_per_s": round(at.env_steps_per_s(), 1),
        "return_mean_last_10": record.recent_return,
        "return_best": record.best,
        "recoveries": at.epoch,
        "segments": asdict(accounts),
        "dropped_transitions": dropped_steps,
        "info_metrics": record.mean_metrics,
        "weights_sha256": hashlib.sha256(graph).hexdigest(),
        "finished": at.env_steps >= run.total_steps,
    }
