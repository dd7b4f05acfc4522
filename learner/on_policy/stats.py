"""The numbers of one update: columns of updates.csv, and metrics."""

from dataclasses import dataclass

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.critics import Fits
from a2s.learner.on_policy.distil import Distilled
from a2s.learner.on_policy.policy import PolicyChange, entropy
from a2s.learner.on_policy.recovery import RecoveryDecision
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.targets import Targets


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateStats:
    """Numbers of one update; losses are 0 where a part was not trained.

    Attributes:
        num_steps: Steps of the batch.
        policy_loss: Of the policy gradient, mean of the last pass.
        distil_loss: Of equation 6.
        q_loss: Mean squared error of Q, in normalised returns.
        value_loss: Of V.
        q_fit_steps: Gradient steps of Q.
        value_fit_steps: Gradient steps of V.
        distil_steps: Gradient steps of equation 6.
        policy_epochs: Passes of the policy gradient.
        kl: KL divergence that the learning rate follows, nats.
        kl_target: What the rule wants it to be.
        learning_rate: Of the policy.
        critic_learning_rate: Of Q and V.
        q_explained_variance: Of this batch's targets by Q before it saw them: held out.
        q_action_correlation: Of ``Q - V`` and ``target - V``, held out as well: does Q know one
            action from another?
        value_explained_variance: By V before its update.
        advantage_std: Of the advantages, in returns, before they are normalised.
        entropy: Of the policy, nats.
        std: Mean standard deviation of the policy.
        return_mean: Running mean of targets.
        return_std: Their running standard deviation.
        q_trusted: 1 when the next suggester lets Q choose.
        improved: 1 when the networks that made the batch are the best so far.
        recovered: 1 when the best networks were restored.
        restored_version: Their version, or -1.
        recovery: The test of equation 5; ``None`` where recovery is off.
    """

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
    q_explained_variance: float
    q_action_correlation: float
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
    decision: RecoveryDecision | None,
    targets: Targets,
    fits: Fits,
    distilled: Distilled,
    change: PolicyChange,
    *,
    advantage_std: float,
    learning_rate: float,
    critic_learning_rate: float,
    q_trusted: bool,
) -> UpdateStats:
    """Put the numbers of an update together."""
    restored = state.best if decision is not None and decision.recover else None
    return UpdateStats(
        num_steps=batch.num_steps,
        policy_loss=change.loss,
        distil_loss=distilled.loss,
        q_loss=fits.q_loss,
        value_loss=fits.value_loss,
        q_fit_steps=fits.q_steps,
        value_fit_steps=fits.value_steps,
        distil_steps=distilled.steps,
        policy_epochs=change.epochs,
        kl=change.kl,
        kl_target=state.learning_rate.kl_target,
        learning_rate=learning_rate,
        critic_learning_rate=critic_learning_rate,
        q_explained_variance=targets.q_explained_variance,
        q_action_correlation=targets.q_action_correlation,
        value_explained_variance=targets.value_explained_variance,
        advantage_std=advantage_std,
        entropy=float(entropy(state.policy.log_std.detach())),
        std=float(state.policy.std().detach().mean()),
        return_mean=state.returns.mean,
        return_std=state.returns.std,
        q_trusted=int(q_trusted),
        improved=int(decision is not None and decision.improved),
        recovered=int(restored is not None),
        restored_version=restored.weights_version if restored else -1,
        recovery=decision,
    )
