"""The presets ``authors`` and ``paper``: algorithm 1 as printed, or as the published code has it.

To be read beside the paper. `AuthorsConfig` has table 3 and where code and text differ; what both
share is a constant here. Source of the constants: the authors' code, unless the paper is named.
"""

import math
from typing import Any

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.networks import Policy
from a2s.learner.on_policy.acting import Suggester
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.batch import Batch, BatchSize
from a2s.learner.on_policy.critics import Fits, Regression
from a2s.learner.on_policy.distil import Distilled, distil_policy, distil_target
from a2s.learner.on_policy.learning_rate import LearningRate
from a2s.learner.on_policy.policy import PolicyChange, gaussian_kl, log_density
from a2s.learner.on_policy.recovery import Recovery
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.stats import UpdateStats, update_stats
from a2s.learner.on_policy.targets import Targets, estimate_targets

FIT_STEPS = 100  # of Q and of V, always
Q_EXTRA_STEPS, VALUE_EXTRA_STEPS = 5000, 100  # more, until the loss is low
FIT_THRESHOLD = 100.0  # mean loss of a fit that is low, in squared returns
MINIBATCH = 128  # of Q, V and equation 6
DISTIL_SUGGESTIONS, DISTIL_STEPS = 10, 50
RECOVERY_LR_DIVISOR, RECOVERY_KL_DIVISOR = 5.0, 1.1  # "reduce the learning rate", section 4.1.1


class Authors:
    """Algorithm 1, with the interface of `a2s.learner.on_policy.update.OnPolicy`.

    Args:
        obs_size: D.
        action_size: A.
        config: Table 3.
        seed: Of the first weights and of every random choice.
    """

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
            episodes=0,
            offset=config.recovery_offset,
        )
        self.train_state = TrainState(  # algorithm 1: initialise pi, Q, V
            obs_size, action_size, config, learning_rate, recovery, seed
        )

    @property
    def updates(self) -> int:
        """Batches learned from."""
        return self.train_state.updates

    @property
    def next_batch(self) -> BatchSize:
        """Whole episodes."""
        return BatchSize(self.config.batch_steps, self.config.min_episodes)

    def suggester(
        self, action_low: Tensor, action_high: Tensor, progress: float = 0.0
    ) -> Suggester:
        """K suggestions, of which the one of largest Q is executed, from the first step on."""
        del progress
        state, picks = self.train_state, self.config.suggestions > 1
        return Suggester(
            normaliser=state.normaliser,
            policy=state.policy,
            q_net=state.q_net if picks else None,
            action_low=action_low,
            action_high=action_high,
            mode="hard" if picks else "first",
            suggestions=self.config.suggestions,
            action_mode="raw",
        )

    def update(
        self, batch: Batch, progress: float = 0.0, *, is_behind: bool = False
    ) -> UpdateStats:
        """Learn from a batch, or go back to the best networks.

        Args:
            batch: Whole episodes, unless something broke one off.
            progress: Not used.
            is_behind: The networks before the last update made it, not the present ones.

        Raises:
            A2SError: The networks are no longer finite.
        """
        config, state, rate = self.config, self.train_state, self.train_state.learning_rate
        decision = state.judge(batch, is_behind=is_behind)  # equation 5; r > r*: keep pi, Q, V
        targets = estimate_targets(  # r^gamma, and r^gamma - V
            batch,
            state,
            batch.suggestion if config.uses_q else None,
            gamma=config.gamma,
            gae_lambda=1.0,
            time_limit_is_terminal=True,
        )
        rate.adapt()
        fits, distilled, change, advantage_std = Fits(), Distilled(), PolicyChange(), 0.0
        recovers = decision is not None and decision.recover
        if recovers:
            rate.kl_target /= RECOVERY_KL_DIVISOR
            state.recover(networks_only=True)
        else:
            fits = self._fit(batch, targets.target)  # update Q, update V
        if not recovers or config.recovery_learns:
            distilled = self._distil(batch.obs)  # equation 6
            advantage = self._advantage(batch, targets)
            advantage_std = float(advantage.std(correction=0))
            change = score_step(  # equation 4
                state.policy,
                state.adam["policy"],
                batch.obs,
                batch.suggestion,
                advantage,
                rate.at(0.0),
            )
            rate.last_kl = change.kl
        state.updates += 1
        state.require_finite()
        now = rate.at(progress)
        return update_stats(
            batch, state, decision, targets, fits, distilled, change, advantage_std=advantage_std,
            learning_rate=now, critic_learning_rate=now, q_trusted=True,
        )  # fmt: skip

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that `load` needs to go on to the bit: tensors, and numbers for JSON."""
        return self.train_state.state()

    def load(self, tensors: dict[str, Tensor], scalars: dict[str, Any]) -> None:
        """Go back to a state of an object made with the same sizes and hyperparameters.

        Raises:
            A2SError: A tensor is missing or has another shape.
        """
        self.train_state.load(tensors, scalars)

    def _fit(self, batch: Batch, target: Tensor) -> Fits:
        """Section 4.1.1: "multiple gradient steps for value network and Q network"."""
        state = self.train_state
        value_loss, value_steps = fit_threshold(
            state.regression_of_value(batch.obs),
            target,
            VALUE_EXTRA_STEPS,
            state.learning_rate.at(0.0),
            state.generators["order"],
        )
        if not self.config.uses_q:
            return Fits(value_loss=value_loss, value_steps=value_steps)
        q_loss, q_steps = fit_threshold(
            state.regression_of_q(batch.obs, batch.suggestion),
            target,
            Q_EXTRA_STEPS,
            state.learning_rate.at(0.0),
            state.generators["q"],
        )
        return Fits(q_loss, value_loss, q_steps, value_steps)

    def _distil(self, obs: Tensor) -> Distilled:
        """Equation 6: the mean moves to the best of K fresh suggestions, in steps of its own."""
        if self.config.distil == "off":
            return Distilled()
        state = self.train_state
        target = distil_target(
            state.q_net,
            state.policy,
            obs,
            suggestions=DISTIL_SUGGESTIONS,
            action_mode="raw",
            generator=state.generators["q"],
        )
        return distil_policy(
            state.policy,
            state.adam["distil"],
            obs,
            target,
            steps=DISTIL_STEPS,
            minibatch=MINIBATCH,
            kl_bound=math.inf,
            learning_rate=state.learning_rate.at(0.0),
            max_grad_norm=0.0,
            generator=state.generators["q"],
        )

    @torch.no_grad()
    def _advantage(self, batch: Batch, targets: Targets) -> Tensor:
        """Return less V before its fit (section 4), or Q less V after theirs (algorithm 1)."""
        if self.config.advantage == "return-v":
            return targets.advantage
        state = self.train_state
        q_value = state.q_net(torch.cat([batch.obs, batch.suggestion], 1))
        advantage: Tensor = q_value - state.value_net(batch.obs)
        return advantage


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

    The authors take the mean of ``log pi`` over the dimensions, which differs by a factor, which
    Adam undoes. Theirs is the divergence: after equation 6, a mean over the dimensions.

    Args:
        policy: Changed in place.
        optimiser: Of the policy gradient.
        obs: ``[N, D]``.
        action: Executed suggestions, not clipped, ``[N, A]``.
        advantage: ``[N]``.
        learning_rate: Of Adam.
    """
    before, log_std = policy(obs), policy.log_std
    mean, layers = policy.trace(obs)
    loss = -(advantage * log_density(mean, log_std, action)).mean()
    grad_log_prob = (advantage / -len(advantage)).unsqueeze(1)
    inverse_std = (-log_std).exp()
    grad_mean = grad_log_prob * ((action - mean) * inverse_std) * inverse_std
    policy.differentiate(layers, grad_mean, torch.zeros_like(log_std))
    optimiser.step(learning_rate, max_grad_norm=0.0)
    kl = gaussian_kl(policy(obs), log_std, before, log_std).sum(1).mean()
    return PolicyChange(float(loss), 1, float(kl) / action.shape[1])


def fit_threshold(
    job: Regression,
    target: Tensor,
    extra_steps: int,
    learning_rate: float,
    generator: torch.Generator,
) -> tuple[float, int]:
    """Fit one network for some steps, then on until the running mean of its losses is low.

    Args:
        job: The network and its inputs.
        target: What it regresses to, ``[N]``.
        extra_steps: At most, after the first 100.
        learning_rate: Of Adam.
        generator: Draws the rows of a step, with replacement.

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
