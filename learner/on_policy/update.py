"""On-policy A2S: one update from one batch.

Source: algorithm 1 of the paper, with equations 5 and 6 of section 4.1.1, the latter in general
(docs/adr/0021). A2C is the same without Q and equation 5. `authors.py` has the paper to the letter.
"""

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy.acting import Suggester
from a2s.learner.on_policy.batch import Batch, BatchSize
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.critics import Fit, Fits, make, make_beside, q_fit, value_fit
from a2s.learner.on_policy.learning_rate import LearningRate
from a2s.learner.on_policy.policy import PolicyChange, PolicyData, importance, improve, normalised
from a2s.learner.on_policy.q_learning import (
    OUTPUT_STD,
    QTargets,
    in_outputs,
    opinion,
    q_targets,
)
from a2s.learner.on_policy.recovery import Recovery
from a2s.learner.on_policy.returns import explained_variance
from a2s.learner.on_policy.state import TrainState
from a2s.learner.on_policy.stats import UpdateStats, update_stats
from a2s.learner.on_policy.suggestions import Pull, pull_of_suggestions
from a2s.learner.on_policy.targets import Targets, estimate_targets

# Bounds of the rule `kl`, by the first learning rate.
_MIN_LEARNING_RATE, _MAX_LEARNING_RATE = 1 / 50, 6.0
_MIN_INVERSE_TEMPERATURE = 1e-6  # as good as none, but the best of K stays the best


class OnPolicy(TrainState):
    """The networks and everything that learning them needs.

    ::

        algorithm = OnPolicy(obs_size, action_size, config, seed)
        while ...:
            graph = export(algorithm.suggester(low, high), ...)
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
        super().__init__(
            obs_size,
            action_size,
            config,
            learning_rate,
            recovery,
            seed,
            window_steps=config.window_steps,
        )

    @property
    def next_batch(self) -> BatchSize:
        """The least that the next batch holds."""
        return BatchSize(self.config.batch_steps_at(self.updates))

    def suggester(self, action_low: Tensor, action_high: Tensor) -> Suggester:
        """The present way of acting; it shares the networks and is valid until the next update.

        The environment's bounds are ``[A]``.
        """
        config = self.config
        picks = self.q_trusted and config.suggestions > 1
        return Suggester(
            normaliser=self.normaliser,
            policy=self.policy,
            q_net=self.q_net if picks else None,
            action_low=action_low,
            action_high=action_high,
            mode="soft" if picks else "first",
            suggestions=config.suggestions if picks else 1,
            inverse_temperature=max(self.act_inverse_temperature, _MIN_INVERSE_TEMPERATURE),
            q_scale=self.returns.std / OUTPUT_STD,
        )

    def update(
        self, batch: Batch, progress: float = 0.0, *, is_behind: bool = False
    ) -> UpdateStats:
        """Learn from a batch, or go back to the best networks.

        Segments are by the present networks, or by ones not much older; with ``is_behind`` by those
        before the last update. ``progress`` is the fraction of the run that is done, 0..1.

        Raises:
            A2SError: The networks are no longer finite.
        """
        config = self.config
        decision = self.judge(batch, is_behind=is_behind)  # equation 5
        with torch.no_grad():
            old_mean = self.policy(self.normaliser(batch.obs))
        self.normaliser.update(batch.obs)
        targets = estimate_targets(
            batch, self, None, gamma=config.gamma, gae_lambda=config.gae_lambda
        )
        self.learning_rate.adapt()
        fits, pull, change = Fits(), None, PolicyChange()
        recovers = decision is not None and decision.recover
        if recovers:
            self.recover()
        rate, left = self.learning_rate.at(progress), self.learning_rate.left(progress)
        critic_rate, q_rate = config.critic_learning_rate * left, config.q_learning_rate * left
        if not recovers:
            data = self._policy_data(batch, old_mean, targets.advantage)
            wanted = None
            if config.uses_q:
                targets = self._ask_q(data, targets)
                wanted = self._q_targets(batch)
            self.returns.update(targets.target)
            value = self._value_fit(data.obs, targets.target, critic_rate)
            if wanted is not None:
                fits = self._fit_q(wanted, q_rate)
                pull = self._suggest(data)  # equation 6
            improve = partial(self._improve, data, pull, rate, progress)  # equation 4
            change, value_loss = make_beside(improve, value)
            fits = fits._replace(value_loss=value_loss, value_fit_steps=value.steps)
            change = change._replace(advantage_std=float(targets.advantage.std(correction=0)))
            self.learning_rate.last_kl = change.kl
        self.end_update()
        return update_stats(
            batch, self, targets, fits, pull, change, decision, rate, critic_rate, q_rate
        )

    def _policy_data(self, batch: Batch, old_mean: Tensor, advantage: Tensor) -> PolicyData:
        """The batch as the policy learns from it, with the policy before the update."""
        config = self.config
        log_std = self.policy.log_std.clone()
        log_prob = log_density((batch.suggestion - old_mean) * (-log_std).exp(), log_std)
        weight = importance(log_prob, batch.log_prob, config.weight_limit)
        return PolicyData(
            obs=self.normaliser(batch.obs),
            action=batch.suggestion,
            log_prob=log_prob,
            advantage=normalised(advantage, weight) if config.norm_advantage else advantage,
            weight=weight,
            mean=old_mean,
            log_std=log_std,
        )

    def _ask_q(self, data: PolicyData, targets: Targets) -> Targets:
        """Compare what Q says of the batch, which it has not seen, with what happened."""
        if not self.q_trusted:
            return targets
        said = opinion(self, data.obs, data.action)
        self.calibration.update(said.over_mean, targets.advantage, data.weight)
        return replace(
            targets,
            q_explained_variance=explained_variance(said.value, targets.target),
            q_action_correlation=self.calibration.correlation,
        )

    def _q_targets(self, batch: Batch) -> QTargets:
        """Take the batch into the window, and make targets for all of it."""
        self.window.add(batch)
        config = self.config
        return q_targets(self.window.joined(), self, gamma=config.gamma, lam=config.q_lambda)

    def _value_fit(self, norm_obs: Tensor, target: Tensor, learning_rate: float) -> Fit:
        """What fits V to the batch, for targets in returns; the policy's step needs no V."""
        config = self.config
        return value_fit(
            self.fit_of_value(norm_obs),
            self.returns.normalise(target),
            epochs=config.critic_epochs,
            minibatch=config.critic_minibatch,
            min_minibatches=config.min_minibatches,
            learning_rate=learning_rate,
            max_grad_norm=config.max_grad_norm,
            generator=self.generators["order"],
        )

    def _fit_q(self, wanted: QTargets, learning_rate: float) -> Fits:
        """Fit both Q to the window, side by side; from now on they may choose."""
        config = self.config
        newest = self.window.kept[-1][1].num_steps
        q = q_fit(
            self.q_net,
            self.adam["q"],
            wanted.inputs,
            in_outputs(self, wanted.target),
            steps=max(round(config.q_steps * newest / config.batch_steps), 1),
            minibatch=config.q_minibatch,
            learning_rate=learning_rate,
            generator=self.generators["q"],
        )
        fits = Fits(q_loss=make(q), q_fit_steps=q.steps)
        self.q_trusted = True
        return fits

    def _suggest(self, data: PolicyData) -> Pull:
        """Ask Q for its opinion of K fresh suggestions in every state of the batch."""
        config = self.config
        pull = pull_of_suggestions(
            self.q_net,
            data.obs,
            data.mean,
            data.log_std.exp(),
            suggestions=config.suggestions,
            factor=self.calibration.factor * self.returns.std / OUTPUT_STD,
            temperature=config.pull_temperature,
            least_share=config.pull_least_share,
            act_least_share=config.act_least_share,
            generator=self.generators["q"],
        )
        self.act_inverse_temperature = pull.act_inverse_temperature
        return pull

    def _improve(
        self, data: PolicyData, pull: Pull | None, learning_rate: float, progress: float
    ) -> PolicyChange:
        """Follow the policy gradient, and what the suggestions want."""
        config, strength = self.config, 0.0
        if pull is not None and config.pull > 0:
            data, strength = replace(data, wanted=pull.mean), pull.strength
        return improve(
            self.policy,
            self.adam["policy"],
            data,
            epochs=config.policy_epochs,
            minibatch=config.policy_minibatch,
            min_minibatches=config.min_minibatches,
            kl_stop=config.kl_stop,
            clip_ratio=config.clip_ratio,
            entropy_weight=config.entropy_weight,
            pull=config.pull * strength,
            std_floor=config.std_floor_at(progress),
            learning_rate=learning_rate,
            max_grad_norm=config.max_grad_norm,
            generator=self.generators["order"],
        )
