"""Off-policy A2S: one update from one batch of a replay.

With one suggestion and one group it is SAC (Haarnoja et al. 2018), number for
number.

Source: equations 7, 8 and algorithm 2 of the paper.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble, score_many
from a2s.learner.networks.gaussian import log_density
from a2s.learner.networks.peers import ALONE, Peers
from a2s.learner.networks.stored import check_tensors
from a2s.learner.off_policy.acting import (
    OffPolicySuggester,
    OffPolicySuggesterMode,
)
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy.losses import CriticLoss, quantile_loss, squared_loss
from a2s.learner.off_policy.noise import Noise, draw_noise
from a2s.learner.off_policy.policy import PolicyStep, pathwise, score
from a2s.learner.off_policy.squashed import (
    Drawn,
    Gaussian,
    draw,
    draw_several,
    gaussian,
)
from a2s.learner.off_policy.state import TrainState
from a2s.learner.off_policy.stats import OffPolicyStats
from a2s.learner.off_policy.targets import backup, evaluate, pick_best
from a2s.learner.off_policy.transitions import Transitions


class OffPolicy:
    """The learner's networks and everything that learning them needs.

    ::

        algorithm = OffPolicy(obs_size, action_size, hyper, seed)
        while ...:
            algorithm.observe(new_obs)
            algorithm.observe_returns(some_returns)
            stats = algorithm.update(replay.sample())
            replay.prioritise(stats.error)

    An update copies nothing to the host, and has the same shapes every time that the policy learns,
    or does not. ``seed`` is for the first weights and every random choice. ``peers`` have the other
    critics: what is asked of this object is then asked of theirs alike, and at the same time.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        hyper: OffPolicyConfig,
        seed: int,
        device: str = "cpu",
        peers: Peers = ALONE,
    ) -> None:
        self.hyper = hyper
        self.obs_size = obs_size
        self.action_size = action_size
        self.device = torch.device(device)
        root = torch.Generator().manual_seed(seed)
        networks, noise = torch.randint(2**62, (2,), generator=root).tolist()
        first = torch.Generator().manual_seed(networks)
        self.train_state = TrainState(obs_size, action_size, hyper, first, self.device, peers)
        self._peers, self._own = peers, peers.own(hyper.num_critics)
        self._noise = torch.Generator().manual_seed(noise)
        self._wanted_entropy = hyper.entropy_per_action * action_size

    def observe(self, obs: Tensor) -> None:
        """Take new observations, float32 ``[N, D]``, into account: each once, when it arrives."""
        self.train_state.normaliser.update(obs.to(self.device))

    def observe_returns(self, returns: Tensor) -> None:
        """Take discounted returns of rows of the replay, float32 ``[N]``, into account."""
        self.train_state.return_size.observe(returns.to(self.device))

    def draw_noise(self, rows: int) -> Noise:
        """Draw the noise of an update of ``rows`` rows: on the CPU, to be the same everywhere."""
        noise = draw_noise(rows, self.action_size, self.hyper, self._noise)
        return Noise(*(each.to(self.device, non_blocking=True) for each in noise))

    def suggester(
        self,
        action_low: Tensor,
        action_high: Tensor,
        *,
        warms_up: bool = False,
        averaged: bool = False,
    ) -> OffPolicySuggester:
        """The present way of acting; it shares the networks and is valid until the next update.

        The environment's bounds are float32 ``[A]``. With ``warms_up`` it acts at random: nothing
        is learned yet. ``averaged`` takes the average of the policy over time, to be kept and used.
        """
        return_size = self.train_state.return_size()
        picks = self.hyper.act_suggestions > 1 and not warms_up
        unjudged: OffPolicySuggesterMode = "uniform" if warms_up else "first"
        return OffPolicySuggester(
            normaliser=self.train_state.normaliser,
            policy=self.train_state.average if averaged else self.train_state.policy,
            critics=self.all_critics() if picks else self.train_state.critics,
            action_low=action_low,
            action_high=action_high,
            mode=self.hyper.selection if picks else unjudged,
            suggestions=self.hyper.act_suggestions if picks else 1,
            temperature=self.train_state.log_temperature.exp() * return_size,
            return_size=return_size,
        )

    @torch.no_grad()
    def update(
        self, batch: Transitions, noise: Noise | None = None, *, learns_policy: bool = True
    ) -> OffPolicyStats:
        """Learn from a batch on the device; noise is drawn here when not given.

        Without ``learns_policy`` policy and temperature stay as they are.
        """
        if noise is None:
            noise = self.draw_noise(len(batch.obs))
        state = self.train_state
        return_size = state.return_size()
        batch = batch._replace(reward=batch.reward / return_size)
        obs, next_obs = state.normaliser(torch.stack((batch.obs, batch.next_obs)))
        temperature = state.log_temperature.exp()
        target = self._target(batch, next_obs, noise, temperature)
        fit, q_mean = self._learn_critics(obs, batch, target)
        policy_loss = entropy = None
        if learns_policy:
            policy_loss, entropy = self._learn_policy(obs, noise, temperature)
        state.update_average()
        state.targets.value.lerp_(state.critics.value, self.hyper.tau)
        state.targets.refresh()
        return OffPolicyStats(
            q_loss=fit.loss,
            policy_loss=policy_loss,
            q_mean=q_mean * return_size,
            target_mean=target.mean() * return_size,
            entropy=entropy,
            temperature=state.log_temperature.exp() * return_size,
            error=fit.error * return_size,
        )

    def all_critics(self) -> Ensemble:
        """This object's and its peers', valid until the next update."""
        return self.train_state.all_critics()

    def is_finite(self) -> bool:
        """Whether every parameter is a number; waits for the device."""
        found = torch.tensor([self.train_state.is_finite()], dtype=torch.uint8)
        return bool(self._peers.gather(found).all())

    def state(self) -> dict[str, Tensor]:
        """Copies of everything that `load` needs to go on to the bit."""
        return self.train_state.state() | {"generator.noise": self._noise.get_state()}

    def begin_with(self, stored: dict[str, Tensor], taken: Sequence[str]) -> None:
        """Take the parts that are named of another object's `state`."""
        self.train_state.begin_with(stored, taken)

    def check(self, tensors: dict[str, Tensor]) -> None:
        """Refuse what `load` cannot take.

        Raises:
            RunDirectoryError: A tensor is missing or has another shape.
        """
        noise = {"generator.noise": self._noise.get_state()}
        check_tensors(tensors, self.train_state.shapes() | noise)

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Go back to a state of an object made with the same sizes and hyperparameters.

        Raises:
            RunDirectoryError: A tensor is missing or has another shape.
        """
        self.check(tensors)
        self.train_state.load(tensors)
        self._noise.set_state(tensors["generator.noise"])

    def _learn_temperature(self, log_prob: Tensor) -> None:
        """Raise the temperature where the entropy is below the wanted one.

        Source: Haarnoja et al. 2018, equation 18, for the logarithm of the temperature.
        """
        if self.train_state.learns_temperature:
            grad = -(log_prob.mean() + self._wanted_entropy)
            self.train_state.adam["temperature"].step(grad, self.hyper.temperature_learning_rate)

    def _target(self, batch: Transitions, obs: Tensor, noise: Noise, temperature: Tensor) -> Tensor:
        """Targets of equation 8, ``[B, M']``."""
        state, hyper = self.train_state, self.hyper
        policy = gaussian(state.policy(obs)[0])
        normal = noise.target
        u = draw_several(policy, normal)
        if hyper.target_suggestions > 1:
            scores = self._select(obs, u.tanh(), noise.critic[:-1])
            u, normal = pick_best(scores, u, normal)
        else:
            u, normal = u.squeeze(2), normal.squeeze(2)
        groups = len(u)
        joined = torch.cat([obs.expand(groups, -1, -1), u.tanh()], dim=-1)
        value = self._peers.gather(state.targets(joined.flatten(0, 1)))
        value = value.view(len(value), groups, len(obs), -1)
        return backup(
            batch.reward,
            batch.discount,
            evaluate(value, hyper.quantiles_to_drop),
            log_density(normal, policy.log_std, u),
            temperature=temperature,
            suggestions=hyper.target_suggestions,
        )

    def _learn_critics(
        self, obs: Tensor, batch: Transitions, target: Tensor
    ) -> tuple[CriticLoss, Tensor]:
        """Regress every critic to the targets; also returns the mean value."""
        critics = self.train_state.critics
        q_value, tape = critics.trace(torch.cat([obs, batch.action], dim=-1))
        q_value = self._peers.gather(q_value)
        if self.hyper.num_quantiles == 1:
            fit = squared_loss(q_value, target, batch.weight)
        else:
            fit = quantile_loss(q_value, target, batch.weight, self.hyper.kappa)
        critics.differentiate(tape, fit.grad[self._own])
        self.train_state.adam["critics"].step(critics.grad, self.hyper.critic_learning_rate)
        critics.refresh()
        return fit, q_value.mean()

    def _learn_policy(
        self, obs: Tensor, noise: Noise, temperature: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Improve the policy by the learned critics, and learn the temperature: loss and entropy.

        The temperature is what it was before.
        """
        state = self.train_state
        output, tape = state.policy.trace(obs)
        policy = gaussian(output[0])
        drawn = draw(policy, noise.suggestion)
        self._learn_temperature(drawn.log_prob)
        moved = self._policy_step(obs, policy, drawn, noise, temperature)
        state.policy.differentiate(tape, moved.grad.unsqueeze(0))
        state.adam["policy"].step(state.policy.grad, self.hyper.learning_rate)
        state.policy.refresh()
        return moved.loss, -drawn.log_prob.mean()

    def _policy_step(
        self, obs: Tensor, policy: Gaussian, drawn: Drawn, noise: Noise, temperature: Tensor
    ) -> PolicyStep:
        """The policy gradient by the learned critics."""
        if self.hyper.policy_loss == "score":
            several = draw_several(policy, noise.distil).tanh()
            q_value = self._select(obs, several[None], noise.critic[-1:])[0]
            return score(policy, noise.distil, q_value, temperature)
        value, action_grad = self._value_of(obs, drawn.action)
        return pathwise(policy, drawn, value, action_grad, temperature)

    def _value_of(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The value of one action a state, ``[B]``, with its gradient by the action, ``[B, A]``.

        Plain critics: their minimum, as in SAC; quantile critics: their mean, as in TQC.
        """
        critics = self.train_state.critics
        q_value, tape = critics.trace(torch.cat([obs, action], dim=-1))
        q_value = self._peers.gather(q_value)
        if self.hyper.num_quantiles > 1:
            grad = torch.full_like(q_value, 1.0 / (len(q_value) * self.hyper.num_quantiles))
            value = q_value.mean((0, 2))
        else:
            least, member = q_value.min(0, keepdim=True)
            grad = torch.zeros_like(q_value).scatter_(0, member, 1.0)
            value = least.flatten()
        by_action = critics.by_input(tape, grad[self._own], self.obs_size)
        return value, self._peers.gather(by_action).sum(0)

    def _select(self, obs: Tensor, action: Tensor, critic: Tensor) -> Tensor:
        """Scores ``[N, B, K]`` of suggestions in N groups, ``[N, B, K, A]``, by one critic a group.

        Observations are normalised, ``[B, D]``; ``critic``, ``[N]``, has the critic of each group.
        """
        critics = self.train_state.critics
        here = critics.weights.pick(critic % critics.members)
        scores = score_many(critics.form, here, obs, action)
        return self._peers.pick(scores, critic // critics.members)
