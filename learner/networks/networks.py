"""Policy, Q and value networks, and the normaliser of what they see.

All three share one body. Whoever calls them normalises the observations first, once.

Source: section 5 and table 3 of the paper (64-64, Q 128-64, fixed standard deviation); layer
normalisation before the non-linearity as in the authors' code.
"""

import math

import torch
from torch import Tensor, nn

from a2s.learner.networks.body import Body, Layer
from a2s.learner.on_policy.presets import AnyOnPolicyConfig

OBS_LIMIT = 10.0
# What of an observation may be rounding (docs/adr/0017): two steps of float32 of its mean, and what
# is left of the largest one in float64, in which environments compute, after 256 roundings; of the
# last not more than a deviation of 1e-4, so that one reading of 1e30 does not hide the others.
_STEPS, _REST, _MOST_REST = 2.0**-22, 2.0**-44, 1e-8
_LEAST = 2.0**-252  # of a variance: one over its root is a float32


class Normaliser(nn.Module):
    """Running mean and standard deviation of observations.

    Where it ``quiets_rare`` ones, each is scaled further by the share of steps in which it was not
    0: by its deviation alone a contact force is the louder the more seldom it is there
    (docs/adr/0016). What does not vary by more than rounding is quiet, whatever the unit
    (docs/adr/0017).

    Buffers: ``mean`` and ``variance``, and where it ``quiets_rare`` ones ``nonzero``, how often
    each was not 0, float64 ``[D]``; ``count``, float64 ``[]``. Before the first observation they
    are 0, but the variance 1. When not enabled, observations pass as they are.
    """

    mean: Tensor
    variance: Tensor
    nonzero: Tensor
    count: Tensor

    def __init__(self, size: int, *, enabled: bool, quiets_rare: bool = False) -> None:
        super().__init__()
        self.enabled = enabled
        self.quiets_rare = quiets_rare
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        if quiets_rare:
            self.register_buffer("nonzero", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Take observations, float32 ``[N, D]``, into account."""
        if not self.enabled:
            return
        added = float(len(obs))
        variance, mean = torch.var_mean(obs.double(), dim=0, correction=0)
        total = self.count + added
        shift = mean - self.mean
        spread = self.variance * self.count + variance * added
        spread += shift.square() * self.count * added / total
        self.mean += shift * added / total
        self.variance.copy_(spread / total)
        self.count.copy_(total)
        if self.quiets_rare:
            self.nonzero += obs.count_nonzero(0)

    def constants(self) -> tuple[Tensor, Tensor]:
        """The mean to subtract and the factor to multiply by, float32 ``[D]`` each.

        The factor is ``deviation / (variance + floor)``: one over the deviation where that is far
        above rounding, and nothing where nothing has varied yet.
        """
        size = self.mean.square()
        largest = (self.variance + size).max()
        floor = _STEPS**2 * size + (_REST**2 * largest).clamp(max=_MOST_REST)
        factor = self.variance.sqrt() / (self.variance + floor).clamp(min=_LEAST)
        if self.quiets_rare:
            factor *= torch.where(self.count > 0, self.nonzero / self.count, 1.0)
        return self.mean.float(), factor.float()

    def forward(self, obs: Tensor) -> Tensor:
        """Normalise and limit to +-10: float32 ``[..., D]`` to ``[..., D]``."""
        if not self.enabled:
            return obs
        mean, factor = self.constants()
        return ((obs - mean) * factor).clamp(-OBS_LIMIT, OBS_LIMIT)


class Policy(nn.Module):
    """A Gaussian: the mean is a network's, the standard deviation the same everywhere.

    Attributes:
        log_std: Float32 ``[A]``; a parameter when learned, else a buffer.
    """

    log_std: Tensor

    def __init__(
        self, obs_size: int, action_size: int, hyper: AnyOnPolicyConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        sizes = (obs_size, *hyper.policy_sizes, action_size)
        self.body = Body(sizes, hyper=hyper, output_gain=0.01, generator=generator)
        log_std = torch.full((action_size,), math.log(hyper.std))
        if hyper.learn_std:
            self.log_std = nn.Parameter(log_std)
        else:
            self.register_buffer("log_std", log_std)
        self.log_floor = math.log(hyper.std_floor) if hyper.std_floor > 0 else -math.inf

    def forward(self, obs: Tensor) -> Tensor:
        """Mean action, canonical, of normalised observations: ``[N, D]`` to ``[N, A]``."""
        mean: Tensor = self.body(obs)
        return mean

    def trace(self, obs: Tensor) -> tuple[Tensor, list[Layer]]:
        """Map like `forward`, and keep what `differentiate` needs."""
        return self.body.trace(obs)

    def differentiate(self, layers: list[Layer], by_mean: Tensor, by_log_std: Tensor) -> None:
        """Overwrite the gradients of all parameters.

        Args:
            layers: Of `trace`.
            by_mean: Gradient of the loss by the means, ``[N, A]``.
            by_log_std: By the log standard deviation, ``[A]``; not used when that is fixed.
        """
        self.body.differentiate(layers, by_mean)
        if isinstance(self.log_std, nn.Parameter):
            assert self.log_std.grad is not None
            self.log_std.grad.copy_(by_log_std)

    def std(self) -> Tensor:
        """Standard deviation, ``[A]``."""
        return self.log_std.exp()

    @torch.no_grad()
    def hold_floor(self) -> None:
        """Lift the standard deviation to its floor, so that its gradient lives on there."""
        if isinstance(self.log_std, nn.Parameter):
            self.log_std.clamp_(min=self.log_floor)


class Value(nn.Module):
    """V: what is to be expected from an observation on."""

    def __init__(self, obs_size: int, hyper: AnyOnPolicyConfig, generator: torch.Generator) -> None:
        super().__init__()
        sizes = (obs_size, *hyper.value_sizes, 1)
        self.body = Body(sizes, hyper=hyper, output_gain=1.0, generator=generator)

    def forward(self, obs: Tensor) -> Tensor:
        """Values of normalised observations, in normalised returns: ``[N, D]`` to ``[N]``."""
        value: Tensor = self.body(obs)
        return value.flatten()


class Q(nn.Module):
    """Q: what is to be expected from an observation and an action on."""

    def __init__(
        self, obs_size: int, action_size: int, hyper: AnyOnPolicyConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        sizes = (obs_size + action_size, *hyper.q_sizes, 1)
        self.obs_size = obs_size
        self.body = Body(sizes, hyper=hyper, output_gain=1.0, generator=generator)

    def forward(self, joint: Tensor) -> Tensor:
        """Values of normalised observations joined with actions: ``[N, D + A]`` to ``[N]``."""
        value: Tensor = self.body(joint)
        return value.flatten()

    def score(self, obs: Tensor, action: Tensor) -> Tensor:
        """Score K actions for every observation; the observation's part is computed once.

        Args:
            obs: Normalised observations, ``[B, D]``.
            action: Actions as Q sees them, ``[B, K, A]``.

        Returns:
            Scores in normalised returns, ``[B, K]``.
        """
        rows, count, _ = action.shape
        first, bias = self.body.weight[0], self.body.bias[0]
        seen = torch.addmm(bias, obs, first[: self.obs_size])
        acted = torch.mm(action.flatten(0, 1), first[self.obs_size :])
        both = acted.view(rows, count, -1) + seen.unsqueeze(1)
        value: Tensor = self.body.after_first(both.flatten(0, 1))
        return value.view(rows, count)
