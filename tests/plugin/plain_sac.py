"""SAC as slowly and obviously as it can be written: autograd, ``torch.optim``, a loop over critics.

Source: Haarnoja et al. 2018, algorithm 1, with the order of Stable-Baselines3: temperature,
critics, policy, targets.
"""

import copy
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from a2s.learner.algorithm.ensemble import Ensemble
from a2s.learner.algorithm.off_policy import OffPolicy
from a2s.learner.algorithm.transitions import Transitions


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


def modules(ensemble: Ensemble) -> list[nn.Sequential]:
    """Each member as ordinary modules with the same weights."""
    form = ensemble.form
    nets = []
    for member in range(ensemble.members):
        left = [view[member] for view in form.views(ensemble.value)]

        def linear(left: list[Tensor] = left) -> nn.Linear:
            weight, bias = left.pop(0), left.pop(0)
            layer = nn.Linear(*weight.shape)
            layer.weight.data, layer.bias.data = weight.t().clone(), bias[0].clone()
            return layer

        def norm(left: list[Tensor] = left) -> list[nn.Module]:
            if not form.layer_norm:
                return []
            gain, offset = left.pop(0), left.pop(0)
            layer = nn.LayerNorm(gain.shape[1])
            layer.weight.data, layer.bias.data = gain[0].clone(), offset[0].clone()
            return [layer]

        parts: list[nn.Module] = [linear()]
        for _ in form.sizes[2:-1] if form.network == "residual" else form.sizes[1:-1]:
            if form.network == "mlp":
                parts += [*norm(), nn.ReLU(), linear()]
            else:
                parts.append(Block(nn.Sequential(*norm(), linear(), nn.ReLU(), linear())))
        if form.network == "residual":
            parts += [*norm(), linear()]
        assert left == []
        nets.append(nn.Sequential(*parts))
    return nets


class PlainSac:
    """Soft actor-critic that starts from the networks of an `OffPolicy`."""

    def __init__(self, start: OffPolicy) -> None:
        hyper, learned = start.hyper, start.learned
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
