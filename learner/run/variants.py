"""The variant that a run is configured for."""

from pathlib import Path

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy_trainer import OffPolicyLearning
from a2s.learner.on_policy_trainer import OnPolicyLearning
from a2s.learner.run.config import Configuration
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Learning, Saved
from a2s.protocol.fields import Spaces


def make_learning(
    configuration: Configuration,
    spaces: Spaces,
    path: Path,
    ledger: Ledger,
    metrics: LearnerMetrics,
    saved: Saved | None,
) -> Learning:
    """Make it for a run in a directory, to begin or to go on from what was saved.

    Raises:
        RunDirectoryError: Its replay cannot be made or opened, or what was saved does not fit.
        UsageError: Its hyperparameters contradict each other.
    """
    run, hyper = configuration.run, configuration.hyper
    if isinstance(hyper, OffPolicyConfig):
        return OffPolicyLearning(
            run.env, spaces, hyper, run.seed, path, ledger, metrics, run.device, saved
        )
    return OnPolicyLearning(spaces, hyper, run.seed, metrics, saved)
