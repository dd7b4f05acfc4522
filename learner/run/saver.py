"""Saves policies and checkpoints, and goes on from them."""

import base64
import logging
from typing import Any

import numpy as np

from a2s.learner.ingest.journal import Journal, Place
from a2s.learner.ingest.ledger import Ledger, Mark
from a2s.learner.run import checkpoint, table_mark
from a2s.learner.run.directory import RunDirectory
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.status import Status
from a2s.learner.trainer import Trainer
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Array

logger = logging.getLogger(__name__)


class Saver:
    """Saves a run, and goes on with it.

    Checkpoints of another ``kind`` of run are refused. The status and the environment's
    ``obs_offset`` are saved as well, and for a run with actors the place in the ``journal`` and the
    mark of the ``ledger``. ``latest`` is the policy that was saved last, as ONNX.
    """

    def __init__(
        self,
        trainer: Trainer,
        status: Status,
        directory: RunDirectory,
        metrics: LearnerMetrics,
        kind: str,
        obs_offset: Array | None,
        journal: Journal | None,
        ledger: Ledger | None,
    ) -> None:
        self._trainer, self._status, self._directory = trainer, status, directory
        self._metrics, self._kind, self._obs_offset = metrics, kind, obs_offset
        self._journal, self._ledger = journal, ledger
        self.latest = b""

    def save(self) -> None:
        """Write ``latest/policy.onnx`` and a checkpoint.

        Raises:
            RunDirectoryError: They cannot be written.
        """
        status, offset, journal = self._status, self._obs_offset, self._journal
        tensors, algorithm = self._trainer.state()
        self.latest = self.keep_policy("latest")
        state = {
            "algorithm": algorithm,
            "rows": status.rows,
            "episodes": status.episodes.count,
            "env_steps": status.env_steps,
            "journal": None if journal is None else list(journal.place),
            "ledger": None if self._ledger is None else list(self._ledger.mark()),
            "tables": table_mark.marks_of(self._directory.path),
            "version": status.version,
            "acting": base64.b64encode(status.acting).decode() if status.is_ahead else "",
            "num_recoveries": status.num_recoveries,
            "best_recent": status.best_recent,
            "wall_s": status.wall_s,
            "obs_offset": None if offset is None else offset.tolist(),
        }
        folder, updates = self._directory.path / "checkpoints", self._trainer.updates
        with self._metrics.checkpoint_seconds.time():
            _, size = checkpoint.save(folder, updates, tensors, state, kind=self._kind)
        if journal is not None:
            journal.roll(min(place(each) for each in checkpoint.states(folder)))
        self._metrics.checkpoint_time.set_to_current_time()
        self._metrics.checkpoint_bytes.set(size)

    def try_save(self) -> None:
        """Save; if that fails the run goes on, for the next time may succeed."""
        try:
            self.save()
        except RunDirectoryError as error:
            self._metrics.checkpoint_failures.inc()
            logger.warning("%s; going on without it", error)

    def keep_policy(self, place: str) -> bytes:
        """Write ``PLACE/policy.onnx``: the present policy, averaged where the variant does."""
        status = self._status
        graph = self._trainer.graph(status.networks_version, status.fraction, averaged=True)
        self._directory.policy(place, graph)
        return graph

    def keep_best(self) -> None:
        """Keep the policy, if the returns of the newest episodes are the best so far."""
        recent, best = self._status.episodes.recent_return, self._status.best_recent
        if recent is not None and (best is None or recent > best):
            self._status.best_recent = recent
            self.keep_policy("best")

    def go_on(self, state: dict[str, Any], *, again: bool) -> None:
        """Restore a checkpoint's state; forget later updates, and episodes that come ``again``."""
        status, kept = self._status, state["episodes"] if again else None
        path = self._directory.path
        for name in table_mark.changed(path, state["tables"]):
            logger.warning("%s: %s; %s", path / name, table_mark.CHANGED, table_mark.REMEDY)
        status.acting = base64.b64decode(state["acting"])
        status.is_ahead = bool(status.acting)
        status.version, status.num_recoveries = state["version"], state["num_recoveries"]
        status.best_recent, status.worked_s = state["best_recent"], state["wall_s"]
        status.updates, status.rows = self._trainer.updates, state["rows"]
        for wall_s, episode_return, length, metrics in self._directory.read_episodes():
            if kept is None or status.episodes.count < kept:
                status.episodes.add(episode_return, length, metrics)
            status.worked_s = max(status.worked_s, wall_s)
        if kept is not None:
            self._directory.keep_episodes(kept)
        self._directory.keep_updates(status.rows)
        self._metrics.go_on(status)


def place(state: dict[str, Any]) -> Place:
    """Where the journal of a run with actors goes on from a checkpoint."""
    return Place(*state["journal"])


def ledger_mark(state: dict[str, Any]) -> Mark | None:
    """What the ledger of a run with actors was at a checkpoint."""
    return None if state["ledger"] is None else Mark(*state["ledger"])


def has_replay(state: dict[str, Any]) -> bool:
    """Whether a checkpoint of a run with actors has learned from a replay of its own."""
    return state["journal"] is not None and "learned_from" in state["algorithm"]


def obs_offset(state: dict[str, Any]) -> Array | None:
    """The environment's offset when a checkpoint was saved; the policy was trained with it."""
    offset = state["obs_offset"]
    return None if offset is None else np.array(offset, dtype=np.float32)
