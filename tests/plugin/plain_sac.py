"""SAC as slowly and obviously as it can be written: autograd, ``torch.optim``, a loop over critics.

Source: Haarnoja et al. 2018, algorithm 1, with the order of Stable-Baselines3: temperature,
critics, policy, targets.
"""

import copy
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy


class PlainStats(NamedTuple):
    """Losses and temperature of one update."""

    q_loss: float
    policy_loss: float
    temperature: float


class Block(nn.Module):
    """What a residual network adds to its input."""

    def __init__(self, layers: nn.Sequential) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, x: Tensor) -> Tensor:
        """Add."""
        out: Tensor = x + self.layers(x)
        return out


class Trunk(nn.Module):
    """What is seen before the late inputs, and then joined with them."""

    def __init__(self, layers: nn.Sequential, late: int) -> None:
        super().__init__()
        self.layers = layers
        self.late = late

    def forward(self, x: Tensor) -> Tensor:
        """Join."""
        return torch.cat([self.layers(x[..., : -self.late]), x[..., -self.late :]], -1)


class _Taking:
    """Makes modules of the parameters of a member that are left, from the first on."""

    def __init__(self, ensemble: Ensemble, member: int) -> None:
        def alone(each: Tensor) -> Tensor:
            return each if ensemble.single else each[member]

        self.form = ensemble.form
        weights = ensemble.form.weights(ensemble.value, single=ensemble.single)
        self.linears = [
            (alone(weight), alone(bias).flatten())
            for weight, bias in zip(weights.weight, weights.bias, strict=True)
        ]
        self.norms = [
            (alone(norm.gain).flatten(), alone(norm.offset).flatten()) for norm in weights.norms
        ]

    def linear(self) -> nn.Linear:
        """Take a weight and a bias."""
        weight, bias = self.linears.pop(0)
        layer = nn.Linear(*weight.shape)
        layer.weight.data, layer.bias.data = weight.t().clone(), bias.clone()
        return layer

    def norm(self) -> list[nn.Module]:
        """Take a gain and an offset, if the form has them."""
        if not self.form.layer_norm:
            return []
        gain, offset = self.norms.pop(0)
        layer = nn.LayerNorm(len(gain))
        layer.weight.data, layer.bias.data = gain.clone(), offset.clone()
        return [layer]

    def activation(self) -> nn.Module:
        """One without parameters."""
        return {"relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}[self.form.activation]()

    def network(self) -> nn.Sequential:
        """Take all."""
        form, hidden = self.form, self.form.sizes[1:-1]
        parts: list[nn.Module] = [self.linear()]
        if form.network == "residual":
            for _ in hidden[1:]:
                inner = (*self.norm(), self.linear(), self.activation(), self.linear())
                parts.append(Block(nn.Sequential(*inner)))
            return nn.Sequential(*parts, *self.norm(), self.linear())
        if form.late:
            below = nn.Sequential(*parts, *self.norm(), self.activation())
            parts, hidden = [Trunk(below, form.late), self.linear()], hidden[1:]
        for _ in hidden:
            parts += [*self.norm(), self.activation(), self.linear()]
        return nn.Sequential(*parts)


def modules(ensemble: Ensemble) -> list[nn.Sequential]:
    """Each member as ordinary modules with the same weights."""
    nets = []
    for member in range(ensemble.members):
        taking = _Taking(ensemble, member)
        nets.append(taking.network())
        assert taking.linears == taking.norms == []
    return nets


class PlainSac:
    """Soft actor-critic that starts from the networks of an `OffPolicy`."""

    def __init__(self, start: OffPolicy) -> None:
        hyper, learned = start.hyper, start.train_state
        self.hyper = hyper
        self.normaliser = copy.deepcopy(learned.normaliser)
        (self.policy,) = modules(learned.policy)
        self.critics = modules(learned.critics)
        self.targets = modules(learned.targets)
        self.log_temperature = nn.Parameter(learned.log_temperature.clone())
        self.wanted_entropy = -1.0 * start.action_size
        critic_parameters = [p for critic in self.critics for p in critic.parameters()]
        self.policy_adam = torch.optim.Adam(self.policy.parameters(), lr=hyper.learning_rate)
        self.critic_adam = torch.optim.Adam(critic_parameters, lr=hyper.critic_learning_rate)
        self.temperature_adam = torch.optim.Adam(
            [self.log_temperature], lr=hyper.temperature_learning_rate
        )

    def act(self, obs: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        """An action and its log density, by the change of variables as it is written."""
        mean, log_std = self.policy(obs).chunk(2, dim=1)
        std = log_std.clamp(-10.0, 2.0).exp()
        u = mean + std * normal
        action = torch.tanh(u)
        gaussian = torch.distributions.Normal(mean, std).log_prob(u)  # type: ignore[no-untyped-call]
        jacobian = torch.log(1.0 - action.double().square()).to(action.dtype)
        return action, (gaussian - jacobian).sum(1)

    def values(self, nets: list[nn.Sequential], obs: Tensor, action: Tensor) -> list[Tensor]:
        """What each critic says."""
        return [net(torch.cat([obs, action], 1)).squeeze(1) for net in nets]

    def update(self, batch: Transitions, here: Tensor, there: Tensor) -> PlainStats:
        """One update with the noise of the suggestion in this and in the next state."""
        obs, next_obs = self.normaliser(batch.obs), self.normaliser(batch.next_obs)
        temperature = self.log_temperature.exp().detach()
        action, log_prob = self.act(obs, here)
        loss = -(self.log_temperature * (log_prob + self.wanted_entropy).detach()).mean()
        step(self.temperature_adam, loss)

        with torch.no_grad():
            next_action, next_log_prob = self.act(next_obs, there)
            least = torch.stack(self.values(self.targets, next_obs, next_action)).amin(0)
            target = batch.reward + batch.discount * (least - temperature * next_log_prob)
        values = self.values(self.critics, obs, batch.action)
        q_loss = sum((0.5 * F.mse_loss(value, target) for value in values), torch.zeros(()))
        step(self.critic_adam, q_loss)

        least = torch.stack(self.values(self.critics, obs, action)).amin(0)
        policy_loss = (temperature * log_prob - least).mean()
        step(self.policy_adam, policy_loss)

        with torch.no_grad():
            for critic, slow in zip(self.critics, self.targets, strict=True):
                for new, old in zip(critic.parameters(), slow.parameters(), strict=True):
                    old.copy_(0.995 * old + 0.005 * new)
        found = (q_loss, policy_loss, self.log_temperature.exp())
        return PlainStats(*(float(each.detach()) for each in found))


def step(adam: torch.optim.Adam, loss: Tensor) -> None:
    """One step down a loss."""
    adam.zero_grad()
    torch.autograd.backward(loss)
    adam.step()
