"""Makes the learner of a run: with actors, or from another run's replay."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from a2s.learner.export.metadata import policy_metadata
from a2s.learner.ingest.admission import Admission
from a2s.learner.ingest.evaluations import Evaluations
from a2s.learner.ingest.ingest import Ingest
from a2s.learner.ingest.journal import Journal, Record, Taken, has, without
from a2s.learner.ingest.journal_feed import JournalFeed, read_again
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.left_over import LeftOver
from a2s.learner.ingest.server import Server
from a2s.learner.initial import begin_with
from a2s.learner.learner import Learner
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.off_policy_processes import Leading
from a2s.learner.off_policy_trainer import AnyReplay, OffPolicyTrainer
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.other_replay import OtherReplay, ReplayFeed
from a2s.learner.own_replay import OwnReplay
from a2s.learner.prior import open_prior
from a2s.learner.processes import Processes
from a2s.learner.replay.remote import ServedReplay
from a2s.learner.run import checkpoint, saver
from a2s.learner.run.config import Configuration
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import View
from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.writing import writing
from a2s.learner.trainer import Saved, Trainer
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)


def make_learner(
    *,
    configuration: Configuration,
    spaces: Spaces,
    layout: Sequence[tuple[str, int]],
    episode_limit: int | None,
    bus: Bus,
    path: Path,
    metrics: LearnerMetrics,
    view: View,
    resume: bool,
    mark: int,
    processes: Processes | None = None,
) -> Learner:
    """Make the learner of a run with actors.

    Actors find it on ``bus``, which is closed at the end. ``layout`` has names and sizes of the
    parts of an observation, in the order of its numbers; ``episode_limit`` is of the environment's
    steps, if it has one. With ``resume`` it goes on with the newest
    checkpoint in ``path``. ``mark`` is of 32 random bits, which tell it from other learners.
    ``processes`` share its work.

    Raises:
        RunDirectoryError: ``path`` cannot be written, or resumed.
        UsageError: The hyperparameters contradict each other, or ``init_from`` does not fit.
    """
    run, hyper = configuration.run, configuration.hyper
    kind = f"{run.variant} on {run.env}"
    saved = checkpoint.load(path / "checkpoints", kind=kind) if resume else None
    if saved is not None:
        spaces = replace(spaces, obs_offset=saver.obs_offset(saved[1]))
    metadata, learned = policy_metadata(run, spaces, layout), _of_trainer(saved)
    known = None if saved is None else saver.ledger_mark(saved[1])
    with writing(path / "segments.log"):
        ledger = Ledger(path / "segments.log", known)
    evaluations = Evaluations()
    journal, records = _journal(path, ledger, saved)
    trainer: Trainer
    store: OwnReplay | OnPolicyTrainer
    if isinstance(hyper, OffPolicyConfig):
        trainer, store = make_off_policy(
            run, spaces, hyper, path, ledger, metadata, metrics, learned,
            again=records is not None, processes=processes,
        )  # fmt: skip
    else:
        trainer = store = OnPolicyTrainer(spaces, hyper, run.seed, metadata, metrics, learned)
    _begin(trainer, configuration, saved)
    past, env_steps = JournalFeed(journal, records or (), store), ledger.accepted_steps
    if saved is not None:
        learned_from = saved[1]["env_steps"]
        env_steps = learned_from if records is not None else max(learned_from, env_steps)
    return Learner(
        run=run,
        trainer=trainer,
        mark=mark,
        connect=partial(
            _connect,
            run,
            spaces,
            episode_limit,
            bus,
            ledger,
            journal,
            metrics,
            store,
            evaluations,
            past.left_over,
        ),
        evaluations=evaluations,
        past=past if records else None,
        journal=journal,
        ledger=ledger,
        env_steps=env_steps,
        path=path,
        kind=kind,
        spaces=spaces,
        saved=saved,
        metrics=metrics,
        view=view,
    )


def _journal(
    path: Path, ledger: Ledger, saved: Saved | None
) -> tuple[Journal, list[Record] | None]:
    """Open the journal of a run, and read what came after a checkpoint; ``None``: nothing can."""
    folder, place = path / "journal", None if saved is None else saver.place(saved[1])
    is_kept = place is not None and has(folder, place)  # before an empty one is begun
    journal = Journal(folder, ledger.accepted_steps)
    if place is None:
        return journal, None
    if not is_kept:
        logger.warning("%s: %s", journal.folder, without(place, ledger.accepted_steps))
        return journal, None
    journal.place = place
    records = read_again(journal, place, ledger)
    if batches := sum(isinstance(record, Taken) for record in records):
        logger.warning("learning again from %d batches that came after the checkpoint", batches)
    return journal, records


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
    processes: Processes | None = None,
) -> Learner:
    """Make a learner without actors, which learns off-policy from another run's replay.

    The arguments are those of `make_learner` and `OtherReplay`.

    Raises:
        UsageError: The replay never holds as much as a batch.
        RunDirectoryError: ``path`` cannot be written, or resumed.
    """
    run, hyper = configuration.run, configuration.hyper
    assert isinstance(hyper, OffPolicyConfig)
    source = OtherReplay(replay, size, max_size, spaces, hyper, run.seed, metrics)
    kind = f"off-policy on {run.env} from a replay"
    saved = checkpoint.load(path / "checkpoints", kind=kind) if resume else None
    learned = _of_trainer(saved)
    algorithm, updates = _off_policy(run, spaces, hyper, learned, processes)
    metadata = policy_metadata(run, spaces)
    trainer = OffPolicyTrainer(
        algorithm, source, spaces, metadata, metrics, updates, knows=_knows(learned)
    )
    _begin(trainer, configuration, saved)
    feed = ReplayFeed(source, trainer, hyper.utd_ratio, metrics)
    return Learner(
        run=run,
        trainer=trainer,
        mark=0,  # nobody joins it
        connect=lambda *_: feed,
        evaluations=Evaluations(),
        env_steps=feed.env_steps(updates),
        path=path,
        kind=kind,
        spaces=spaces,
        saved=saved,
        metrics=metrics,
        view=view,
    )


def _begin(trainer: Trainer, configuration: Configuration, saved: Saved | None) -> None:
    """Have a run that does not go on begin with what another has learned, if that is wanted."""
    path = configuration.run.init_from
    if path and saved is None:
        logger.warning("%s", begin_with(trainer, Path(path), configuration))


def make_off_policy(
    run: RunConfig,
    spaces: Spaces,
    hyper: OffPolicyConfig,
    path: Path,
    ledger: Ledger,
    metadata: dict[str, str],
    metrics: LearnerMetrics,
    saved: Saved | None,
    *,
    again: bool = False,
    processes: Processes | None = None,
) -> tuple[OffPolicyTrainer, OwnReplay]:
    """Make the trainer and the replay of a run in a directory.

    What the replay got since it was ``saved`` comes ``again``, or stays.

    Raises:
        RunDirectoryError: The replay cannot be made or opened, or what was saved or the prior data
            do not fit.
        UsageError: The hyperparameters contradict each other.
    """
    algorithm, updates = _off_policy(run, spaces, hyper, saved, processes)
    state = saved[1] if saved else None
    prior = open_prior(run, spaces, hyper.batch_rows, state)
    if prior is not None:
        logger.warning("%s", prior)
    replay = OwnReplay(
        path / "replay", run.env, spaces, hyper, run.seed, ledger, metrics, state, prior,
        again=again,
    )  # fmt: skip
    trainer = OffPolicyTrainer(
        algorithm, replay, spaces, metadata, metrics, updates, knows=_knows(saved)
    )
    return trainer, replay


def _off_policy(
    run: RunConfig,
    spaces: Spaces,
    hyper: OffPolicyConfig,
    saved: Saved | None,
    processes: Processes | None,
) -> tuple[OffPolicy, int]:
    """Make the algorithm in the state to go on from, after this number of updates."""
    sizes = spaces.obs_size, spaces.action_size
    if processes is None:
        algorithm = OffPolicy(*sizes, hyper, run.seed, run.device)
    else:
        algorithm = Leading(*sizes, hyper, run.seed, processes)
    if saved is None:
        return algorithm, 0
    algorithm.load(saved[0])
    return algorithm, saved[1]["updates"]


def _connect(
    run: RunConfig,
    spaces: Spaces,
    episode_limit: int | None,
    bus: Bus,
    ledger: Ledger,
    journal: Journal,
    metrics: LearnerMetrics,
    store: OwnReplay | OnPolicyTrainer,
    evaluations: Evaluations,
    left_over: LeftOver,
    generation: int,
    on_event: Callable[..., None],
) -> Server:
    """Make the feed that actors find on the bus; it answers once it is opened."""
    lag, suggestion = store.max_policy_lag, store.max_suggestion
    limit = episode_limit or 0
    admission = Admission(run, spaces, generation, lag, suggestion, limit, store.short_steps)
    ingest = Ingest(admission, ledger, metrics, on_event, store, journal, left_over)
    keys = Keys(run.run)
    if isinstance(store, OwnReplay):
        ServedReplay(bus, keys, store.replay, generation).open()
    return Server(bus, keys, generation, ingest, evaluations, metrics)


def _of_trainer(saved: Saved | None) -> Saved | None:
    return None if saved is None else (saved[0], saved[1]["algorithm"])


def _knows(saved: Saved | None) -> bool:
    """Whether off-policy a run had begun with what another one has learned."""
    return saved is not None and saved[1].get("knows", False)
