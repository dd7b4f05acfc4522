"""On-policy A2S: one update from one batch.

Source: algorithm 1 of the paper, with equations 5 and 6 of section 4.1.1. A2C is the same with one
suggestion and neither equation. `authors.py` has the paper to the letter.
"""

import torch
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy.acting import Suggester, as_q_sees, inverse_temperature
from a2s.learner.on_policy.batch import Batch, BatchSize
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.critics import Fits, fit_critics
from a2s.learner.on_policy.distil import Distilled, distil_policy, distil_target
from a2s.learner.on_policy.learning_rate import LearningRate
from a2s.learner.on_policy.policy import (
    PolicyChange,
    PolicyData,
    importance,
    improve,
    normalised,
)
from a2s.learner.on_policy.recovery import Recovery
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.stats import UpdateStats, update_stats
from a2s.learner.on_policy.targets import estimate_targets

# Bounds of the rule `kl`, by the first learning rate.
_MIN_LEARNING_RATE, _MAX_LEARNING_RATE = 1 / 50, 6.0


class OnPolicy(TrainState):
    """The networks and everything that learning them needs.

    ::

        algorithm = OnPolicy(obs_size, action_size, config, seed)
        while ...:
            graph = export(algorithm.suggester(low, high, progress), ...)
            stats = algorithm.update(batch)
    """

    def __init__(self, obs_size: int, action_size: int, config: OnPolicyConfig, seed: int) -> None:
        self.config = config
        learning_rate = LearningRate(
            rule=config.lr_rule,
            first=config.learning_rate,
            kl_target=config.kl_target,
            recovery_divisor=config.recovery_lr_divisor,
            low=config.learning_rate * _MIN_LEARNING_RATE,
            high=config.learning_rate * _MAX_LEARNING_RATE,
        )
        recovery = Recovery(
            rule=config.recovery,
            bias=config.recovery_bias,
            statistic=config.recovery_statistic,
            episodes=config.recovery_episodes,
            cool_down=config.recovery_cool_down,
        )
        super().__init__(obs_size, action_size, config, learning_rate, recovery, seed)

    @property
    def next_batch(self) -> BatchSize:
        """The least that the next batch holds."""
        return BatchSize(self.config.batch_steps_at(self.updates))

    def suggester(
        self, action_low: Tensor, action_high: Tensor, progress: float = 0.0
    ) -> Suggester:
        """The present way of acting; it shares the networks and is valid until the next update.

        The environment's bounds are ``[A]``. ``progress`` is the fraction of the run that is done,
        0..1; only ``anneal_selection`` reads it.
        """
        config = self.config
        inverse = inverse_temperature(progress) if config.anneal_selection else 1.0
        picks = self.q_trusted and config.suggestions > 1
        return Suggester(
            normaliser=self.normaliser,
            policy=self.policy,
            q_net=self.q_net if picks else None,
            action_low=action_low,
            action_high=action_high,
            mode=config.selection if picks else "first",
            suggestions=config.suggestions if picks else 1,
            temperature=config.selection_temperature / inverse,
            q_scale=self.returns.std,
        )

    def update(
        self, batch: Batch, progress: float = 0.0, *, is_behind: bool = False
    ) -> UpdateStats:
        """Learn from a batch, or go back to the best networks.

        Segments are by the present networks, or by ones not much older; with ``is_behind`` by those
        before the last update. ``progress`` is the fraction of the run that is done, 0..1; only
        ``lr_rule = anneal`` reads it.

        Raises:
            A2SError: The networks are no longer finite.
        """
        config = self.config
        decision = self.judge(batch, is_behind=is_behind)  # equation 5
        with torch.no_grad():
            old_mean = self.policy(self.normaliser(batch.obs))
        self.normaliser.update(batch.obs)
        q_action = as_q_sees(batch.suggestion, "clip") if config.uses_q else None
        targets = estimate_targets(
            batch, self, q_action, gamma=config.gamma, gae_lambda=config.gae_lambda
        )
        self.learning_rate.adapt()
        fits, distilled, change = Fits(), Distilled(), PolicyChange()
        recovers = decision is not None and decision.recover
        if recovers:
            self.recover()
        rate = self.learning_rate.at(progress)
        critic_rate = config.critic_learning_rate * self.learning_rate.left(progress)
        if not recovers:
            norm_obs = self.normaliser(batch.obs)
            fits = self._fit_critics(norm_obs, q_action, targets.target, critic_rate)
            distilled = self._distil(norm_obs, rate)  # equation 6
            change = self._improve(batch, norm_obs, targets.advantage, old_mean, rate)  # equation 4
            self.learning_rate.last_kl = change.kl
        self.end_update()
        return update_stats(
            batch, self, targets, fits, distilled, change, decision, rate, critic_rate
        )

    def _fit_critics(
        self, norm_obs: Tensor, q_action: Tensor | None, target: Tensor, learning_rate: float
    ) -> Fits:
        """Fit Q and V; from now on Q may choose."""
        config = self.config
        self.returns.update(target)
        self.q_trusted = True
        return fit_critics(
            self.fit_of_value(norm_obs),
            None if q_action is None else self.fit_of_q(norm_obs, q_action),
            self.returns.normalise(target),
            epochs=config.critic_epochs,
            minibatch=config.critic_minibatch,
            min_minibatches=config.min_minibatches,
            learning_rate=learning_rate,
            max_grad_norm=config.max_grad_norm,
            generator=self.generators["order"],
        )

    def _distil(self, norm_obs: Tensor, learning_rate: float) -> Distilled:
        config = self.config
        if config.distil == "off":
            return Distilled()
        target = distil_target(
            self.q_net,
            self.policy,
            norm_obs,
            suggestions=config.distil_suggestions,
            action_mode="clip",
            generator=self.generators["q"],
        )
        return distil_policy(
            self.policy,
            self.adam["distil"],
            norm_obs,
            target,
            steps=config.distil_steps,
            minibatch=config.distil_minibatch,
            kl_bound=config.distil_kl,
            learning_rate=learning_rate,
            max_grad_norm=config.max_grad_norm,
            generator=self.generators["q"],
        )

    def _improve(
        self, batch: Batch, norm_obs: Tensor, advantage: Tensor, old_mean: Tensor, rate: float
    ) -> PolicyChange:
        """Follow the policy gradient; the ratio and the divergence are from before equation 6."""
        config = self.config
        old_log_std = self.policy.log_std.clone()  # which equation 6 does not move
        normal = (batch.suggestion - old_mean) * (-old_log_std).exp()
        log_prob = log_density(normal, old_log_std)
        weight = importance(log_prob, batch.log_prob, config.weight_limit)
        data = PolicyData(
            obs=norm_obs,
            action=batch.suggestion,
            log_prob=log_prob,
            advantage=normalised(advantage, weight) if config.norm_advantage else advantage,
            weight=weight,
            mean=old_mean,
            log_std=old_log_std,
        )
        change = improve(
            self.policy,
            self.adam["policy"],
            data,
            epochs=config.policy_epochs,
            minibatch=config.policy_minibatch,
            min_minibatches=config.min_minibatches,
            kl_stop=config.kl_stop,
            clip_ratio=config.clip_ratio,
            entropy_weight=config.entropy_weight,
            learning_rate=rate,
            max_grad_norm=config.max_grad_norm,
            generator=self.generators["order"],
        )
        return change._replace(advantage_std=float(advantage.std(correction=0)))
