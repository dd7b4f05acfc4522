"""Running mean and deviation of observations, by which they are scaled before networks see them."""

import torch
from torch import Tensor, nn

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
