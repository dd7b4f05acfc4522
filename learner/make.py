"""Makes the learner of a run: with actors, or from another run's replay."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from a2s.learner.export.metadata import policy_metadata
from a2s.learner.feed import Feed
from a2s.learner.ingest.admission import Admission
from a2s.learner.ingest.clock import clock_of
from a2s.learner.ingest.ingest import Ingest
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.server import Server
from a2s.learner.learner import POSITION, Learner
from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.off_policy_trainer import AnyReplay, OffPolicyTrainer
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.other_replay import OtherReplay, ReplayFeed
from a2s.learner.own_replay import OwnReplay
from a2s.learner.replay.served import ServedReplay
from a2s.learner.run import checkpoint
from a2s.learner.run.config import Configuration, RunConfig
from a2s.learner.run.directory import RunDirectory
from a2s.learner.run.episode_log import EpisodeLog
from a2s.learner.run.memory import keep_freed_memory
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import View
from a2s.learner.run.saver import Saver
from a2s.learner.run.status import Status
from a2s.learner.trainer import Saved, Trainer
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.transport import Bus


def make_learner(
    *,
    configuration: Configuration,
    spaces: Spaces,
    layout: Sequence[tuple[str, int]],
    bus: Bus,
    path: Path,
    metrics: LearnerMetrics,
    view: View,
    resume: bool,
) -> Learner:
    """Make the learner of a run with actors.

    Args:
        configuration: Of the run.
        spaces: Of its environment.
        layout: Names and sizes of the parts of an observation, in the order of its numbers.
        bus: A connection on which actors find it; closed at the end.
        path: Directory of the run.
        metrics: Of this process.
        view: Where progress is shown.
        resume: Go on from the newest checkpoint in ``path``.

    Raises:
        RunDirectoryError: ``path`` cannot be written, or resumed.
        UsageError: The hyperparameters contradict each other.
    """
    run, hyper = configuration.run, configuration.hyper
    _prepare(run)
    kind = f"{run.variant} on {run.env}"
    saved = checkpoint.load(path / "checkpoints", kind=kind) if resume else None
    if saved is not None:
        offset = saved[1]["obs_offset"]
        kept = None if offset is None else np.array(offset, dtype=np.float32)
        spaces = replace(spaces, obs_offset=kept)
    metadata = policy_metadata(run, spaces, layout)
    ledger = Ledger(path / "segments.log")
    trainer: Trainer
    store: OwnReplay | OnPolicyTrainer
    if isinstance(hyper, OffPolicyHyper):
        trainer, store = make_off_policy(
            run, spaces, hyper, path, ledger, metadata, metrics, _of_trainer(saved)
        )
    else:
        trainer = store = OnPolicyTrainer(
            spaces, hyper, run.seed, metadata, metrics, _of_trainer(saved)
        )
    metrics.env_steps.inc(ledger.accepted_steps)

    def connect(status: Status, on_event: Callable[..., None]) -> Feed:
        keys, generation = Keys(run.run), status.generation
        lag, suggestion = store.max_policy_lag, store.max_suggestion
        admission = Admission(run, spaces, generation, lag, suggestion)
        ingest = Ingest(admission, ledger, metrics, on_event, store)
        if isinstance(store, OwnReplay):
            ServedReplay(bus, keys, store.replay, generation).open()
        return Server(bus, keys, generation, ingest, store, metrics)

    return _assemble(
        run, trainer, connect, ledger.accepted_steps, path, metrics, view, kind, spaces, saved
    )


def make_replay_learner(
    *,
    configuration: Configuration,
    spaces: Spaces,
    replay: AnyReplay,
    size: Callable[[], int],
    max_size: int,
    path: Path,
    metrics: LearnerMetrics,
    view: View,
    resume: bool,
) -> Learner:
    """Make a learner without actors, which learns off-policy from another run's replay.

    The arguments are those of `make_learner` and `OtherReplay`.

    Raises:
        UsageError: The replay never holds as much as a batch.
        RunDirectoryError: ``path`` cannot be written, or resumed.
    """
    run, hyper = configuration.run, configuration.hyper
    assert isinstance(hyper, OffPolicyHyper)
    _prepare(run)
    source = OtherReplay(replay, size, max_size, spaces, hyper, run.seed, metrics)
    kind = f"off-policy on {run.env} from a replay"
    saved = checkpoint.load(path / "checkpoints", kind=kind) if resume else None
    algorithm, updates = _off_policy(run, spaces, hyper, _of_trainer(saved))
    metadata = policy_metadata(run, spaces)
    trainer = OffPolicyTrainer(algorithm, source, spaces, metadata, metrics, updates)
    feed = ReplayFeed(source, trainer, hyper.updates_per_step)
    steps = feed.env_steps(updates)
    return _assemble(run, trainer, lambda *_: feed, steps, path, metrics, view, kind, spaces, saved)


def make_off_policy(
    run: RunConfig,
    spaces: Spaces,
    hyper: OffPolicyHyper,
    path: Path,
    ledger: Ledger,
    metadata: dict[str, str],
    metrics: LearnerMetrics,
    saved: Saved | None,
) -> tuple[OffPolicyTrainer, OwnReplay]:
    """Make the trainer and the replay of a run in a directory.

    Raises:
        RunDirectoryError: The replay cannot be made or opened, or what was saved does not fit.
        UsageError: The hyperparameters contradict each other.
    """
    algorithm, updates = _off_policy(run, spaces, hyper, saved)
    replay = OwnReplay(
        path / "replay", run.env, spaces, hyper, run.seed, ledger, metrics,
        saved[1] if saved else None,
    )  # fmt: skip
    trainer = OffPolicyTrainer(algorithm, replay, spaces, metadata, metrics, updates)
    return trainer, replay


def _off_policy(
    run: RunConfig, spaces: Spaces, hyper: OffPolicyHyper, saved: Saved | None
) -> tuple[OffPolicy, int]:
    """Make the algorithm in the state to go on from, after so many updates."""
    algorithm = OffPolicy(spaces.obs_size, spaces.action_size, hyper, run.seed, run.device)
    if saved is None:
        return algorithm, 0
    algorithm.load(saved[0])
    return algorithm, saved[1]["updates"]


def _assemble(
    run: RunConfig,
    trainer: Trainer,
    connect: Callable[[Status, Callable[..., None]], Feed],
    env_steps: int,
    path: Path,
    metrics: LearnerMetrics,
    view: View,
    kind: str,
    spaces: Spaces,
    saved: Saved | None,
) -> Learner:
    """Put together what any learner has, and begin its directory or go on with it."""
    status = Status(run)
    directory = RunDirectory(path, (*POSITION, *trainer.columns), lambda: status.wall_s)
    saver = Saver(trainer, status, directory, metrics, kind, spaces)
    if saved is None:
        saver.save()
    else:
        saver.go_on(saved[1])
    status.generation = directory.count_start()
    status.env_steps = status.steps_at_start = env_steps
    return Learner(
        status=status,
        feed=connect(status, directory.event),
        trainer=trainer,
        overlaps=trainer.overlaps_learning and clock_of(run.clock).waits_for_weights,
        saver=saver,
        episodes=EpisodeLog(status.episodes, directory, metrics, run.env_config().metric_names),
        directory=directory,
        metrics=metrics,
        view=view,
    )


def _of_trainer(saved: Saved | None) -> Saved | None:
    return None if saved is None else (saved[0], saved[1]["algorithm"])


def _prepare(run: RunConfig) -> None:
    torch.set_num_threads(run.threads)
    keep_freed_memory()
