"""The numbers of one update: columns of updates.csv, and metrics."""

from dataclasses import dataclass

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.critics import Fits
from a2s.learner.on_policy.policy import PolicyChange, entropy
from a2s.learner.on_policy.recovery import RecoveryDecision
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.suggestions import Pull
from a2s.learner.on_policy.targets import Targets


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateStats:
    """Numbers of one update; 0 where a part was not trained. docs/algorithm.md explains each."""

    num_steps: int
    policy_loss: float
    distil_loss: float
    q_loss: float
    value_loss: float
    q_fit_steps: int
    value_fit_steps: int
    distil_steps: int
    policy_epochs: int
    kl: float
    kl_target: float
    learning_rate: float
    critic_learning_rate: float
    q_learning_rate: float
    q_explained_variance: float
    q_action_correlation: float
    q_slope: float
    pull_strength: float
    value_explained_variance: float
    advantage_std: float
    entropy: float
    std: float
    return_mean: float
    return_std: float
    q_trusted: int
    improved: int
    recovered: int
    restored_version: int
    recovery: RecoveryDecision | None


def update_stats(
    batch: Batch,
    state: TrainState,
    targets: Targets,
    fits: Fits,
    pull: Pull | None,
    change: PolicyChange,
    decision: RecoveryDecision | None,
    learning_rate: float,
    critic_learning_rate: float,
    q_learning_rate: float,
) -> UpdateStats:
    """Put the numbers of an update together; those of the parts are named as the columns."""
    restored = state.best if decision is not None and decision.recover else None
    return UpdateStats(
        num_steps=batch.num_steps,
        **fits._asdict(),
        **change._asdict(),
        kl_target=state.learning_rate.kl_target,
        learning_rate=learning_rate,
        critic_learning_rate=critic_learning_rate,
        q_learning_rate=q_learning_rate,
        q_explained_variance=targets.q_explained_variance,
        q_action_correlation=targets.q_action_correlation,
        q_slope=state.calibration.slope,
        pull_strength=0.0 if pull is None else pull.strength,
        value_explained_variance=targets.value_explained_variance,
        entropy=float(entropy(state.policy.log_std)),
        std=float(state.policy.std().mean()),
        return_mean=state.returns.mean,
        return_std=state.returns.std,
        q_trusted=int(state.q_trusted),
        improved=int(decision is not None and decision.improved),
        recovered=int(restored is not None),
        restored_version=restored.weights_version if restored else -1,
        recovery=decision,
    )
