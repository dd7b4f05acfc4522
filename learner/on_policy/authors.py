"""The presets ``authors`` and ``paper``: algorithm 1 as printed, or as the published code has it.

To be read beside the paper. `AuthorsConfig` has table 3 and where code and text differ; what both
share is a constant here. Source of the constants: the authors' code, unless the paper is named.
"""

import math

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import Policy, log_density
from a2s.learner.on_policy.acting import Suggester
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.batch import Batch, BatchSize
from a2s.learner.on_policy.critics import Fits, Regression
from a2s.learner.on_policy.distil import Distilled, distil_policy, distil_target
from a2s.learner.on_policy.learning_rate import LearningRate
from a2s.learner.on_policy.policy import PolicyChange, gaussian_kl
from a2s.learner.on_policy.recovery import Recovery
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.stats import UpdateStats, update_stats
from a2s.learner.on_policy.targets import estimate_targets

FIT_STEPS = 100  # of Q and of V, always
Q_EXTRA_STEPS, VALUE_EXTRA_STEPS = 5000, 100  # more, until the loss is low
FIT_THRESHOLD = 100.0  # mean loss of a fit that is low, in squared returns
MINIBATCH = 128  # of Q, V and equation 6
DISTIL_SUGGESTIONS, DISTIL_STEPS = 10, 50
RECOVERY_LR_DIVISOR, RECOVERY_KL_DIVISOR = 5.0, 1.1  # section 4.1.1: smaller steps after it


class Authors(TrainState):
    """Algorithm 1, with the interface of `a2s.learner.on_policy.update.OnPolicy`."""

    def __init__(self, obs_size: int, action_size: int, config: AuthorsConfig, seed: int) -> None:
        self.config = config
        learning_rate = LearningRate(  # section 4.1.1: it keeps the divergence around kl_target
            rule="kl",
            first=config.learning_rate,
            kl_target=config.kl_target,
            recovery_divisor=RECOVERY_LR_DIVISOR,
            low=0.0,
            high=math.inf,
        )
        recovery = Recovery(  # equation 5
            rule=config.recovery,
            bias=config.recovery_bias,
            statistic=config.recovery_statistic,
            episodes=0,  # those of the batch
            offset=config.recovery_offset,
        )
        # Algorithm 1: initialise pi, Q, V.
        super().__init__(obs_size, action_size, config, learning_rate, recovery, seed)
        self.q_trusted = True

    @property
    def next_batch(self) -> BatchSize:
        """Whole episodes."""
        return BatchSize(self.config.batch_steps, self.config.min_episodes)

    def suggester(self, action_low: Tensor, action_high: Tensor) -> Suggester:
        """K suggestions, of which the one of largest Q is executed, from the first step on."""
        picks = self.config.suggestions > 1
        return Suggester(
            normaliser=self.normaliser,
            policy=self.policy,
            q_net=self.q_net if picks else None,
            action_low=action_low,
            action_high=action_high,
            mode="hard" if picks else "first",
            suggestions=self.config.suggestions,
            action_mode="raw",
        )

    def update(
        self, batch: Batch, progress: float = 0.0, *, is_behind: bool = False
    ) -> UpdateStats:
        """Learn from a batch of whole episodes, or go back to the best networks.

        Raises:
            A2SError: The networks are no longer finite.
        """
        del progress
        config, rate = self.config, self.learning_rate
        decision = self.judge(batch, is_behind=is_behind)  # equation 5; r > r*: keep pi, Q, V
        targets = estimate_targets(  # r^gamma, and r^gamma - V
            batch,
            self,
            batch.suggestion if config.uses_q else None,
            gamma=config.gamma,
            gae_lambda=1.0,
            time_limit_is_terminal=True,
        )
        rate.adapt()
        fits, change = Fits(), PolicyChange()
        recovers = decision is not None and decision.recover
        if recovers:
            rate.kl_target /= RECOVERY_KL_DIVISOR
            self.recover(networks_only=True)
        else:
            fits = self._fit(batch, targets.target)  # update V, update Q
        if not recovers or config.recovery_learns:
            distilled = self._distil(batch.obs)  # equation 6
            advantage = targets.advantage if config.advantage == "return-v" else self._q_v(batch)
            change = score_step(  # equation 4
                self.policy,
                self.adam["policy"],
                batch.obs,
                batch.suggestion,
                advantage,
                rate.at(0.0),
            )
            rate.last_kl = change.kl
            change = change._replace(**distilled._asdict())
        self.end_update()
        return update_stats(
            batch, self, targets, fits, None, change, decision, *3 * (rate.at(0.0),)
        )

    def _fit(self, batch: Batch, target: Tensor) -> Fits:
        """Section 4.1.1: "multiple gradient steps for value network and Q network"."""
        rate, order = self.learning_rate.at(0.0), self.generators
        value = self.fit_of_value(batch.obs)
        value_loss, value_steps = fit(value, target, VALUE_EXTRA_STEPS, rate, order["order"])
        if not self.config.uses_q:
            return Fits(value_loss=value_loss, value_fit_steps=value_steps)
        q = self.fit_of_q(batch.obs, batch.suggestion)
        q_loss, q_steps = fit(q, target, Q_EXTRA_STEPS, rate, order["q"])
        return Fits(q_loss, value_loss, q_steps, value_steps)

    def _distil(self, obs: Tensor) -> Distilled:
        """Equation 6: the mean moves to the best of K fresh suggestions, in steps of its own."""
        if self.config.distil == "off":
            return Distilled()
        target = distil_target(
            self.q_net,
            self.policy,
            obs,
            suggestions=DISTIL_SUGGESTIONS,
            action_mode="raw",
            generator=self.generators["q"],
        )
        return distil_policy(
            self.policy,
            self.adam["distil"],
            obs,
            target,
            steps=DISTIL_STEPS,
            minibatch=MINIBATCH,
            kl_bound=math.inf,
            learning_rate=self.learning_rate.at(0.0),
            max_grad_norm=0.0,
            generator=self.generators["q"],
        )

    @torch.no_grad()
    def _q_v(self, batch: Batch) -> Tensor:
        """Algorithm 1: A = Q - V, both after their fit."""
        q_value = self.q_net(torch.cat([batch.obs, batch.suggestion], 1))
        return (q_value - self.value_net(batch.obs)).squeeze(1)


def fit(
    job: Regression,
    target: Tensor,
    extra_steps: int,
    learning_rate: float,
    generator: torch.Generator,
) -> tuple[float, int]:
    """Make 100 steps of rows drawn with replacement, then more until their mean loss is below 100.

    Returns:
        Mean loss, and steps made.
    """
    total = 0.0
    for made in range(1, FIT_STEPS + extra_steps + 1):
        rows = torch.randint(len(target), (MINIBATCH,), generator=generator)
        total += job.step(job.inputs[rows], target[rows], learning_rate).item()
        if made > FIT_STEPS and total / made < FIT_THRESHOLD:
            break
    return total / made, made


@torch.no_grad()
def score_step(
    policy: Policy,
    optimiser: Adam,
    obs: Tensor,
    action: Tensor,
    advantage: Tensor,
    learning_rate: float,
) -> PolicyChange:
    """Equation 4: one step up ``mean(log pi(u|s) * A)`` with a fixed deviation.

    The authors take the mean of ``log pi`` over the dimensions: a factor, which Adam undoes. As
    theirs, the divergence is that of this step alone, and its mean over the dimensions.
    """
    before, log_std = policy(obs), policy.log_std
    mean, tape = policy.trace(obs)
    inverse_std = (-log_std).exp()
    normal = (action - mean) * inverse_std
    loss = -(advantage * log_density(normal, log_std)).mean()
    grad_log_prob = (advantage / -len(advantage)).unsqueeze(1)
    grad_mean = grad_log_prob * normal * inverse_std
    policy.differentiate(tape, grad_mean, torch.zeros_like(log_std))
    optimiser.step(policy.grad, learning_rate)
    kl = gaussian_kl(policy(obs), log_std, before, log_std).sum(1).mean()
    spread = float(advantage.std(correction=0))
    return PolicyChange(float(loss), 1, float(kl) / action.shape[1], spread)
