"""Gaussian policies: their log density, and the one whose deviation is the same in every state."""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble, Tape
from a2s.learner.networks.form import Form
from a2s.learner.networks.options import Init

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


def log_density(normal: Tensor, log_std: Tensor, squashed: Tensor | None = None) -> Tensor:
    """Log density of ``u = mean + std * normal``, or of ``tanh(u)``, summed over the dimensions.

    ``normal`` is ``[..., A]``, ``log_std`` ``[..., A]`` or ``[A]``. ``squashed`` is u, ``[...,
    A]``, if the density is that of ``tanh(u)``.

    Returns:
        ``[...]``. ``log(1 - tanh(u)^2)`` is written ``2 (log 2 - u - softplus(-2 u))``, which is
        exact for large u too.
    """
    if squashed is None:
        return -0.5 * normal.square().sum(-1) - (log_std + HALF_LOG_2PI).sum(-1)
    half = (squashed + F.softplus(-2.0 * squashed)).sub_(log_std, alpha=0.5)
    half.addcmul_(normal, normal, value=-0.25)
    return 2.0 * half.sum(-1) - normal.shape[-1] * (HALF_LOG_2PI + 2.0 * math.log(2.0))


class Policy:
    """A Gaussian: the mean is a network's, the standard deviation the same everywhere.

    ``sizes``, ``layer_norm`` and ``init`` are those of the network, see `Form`. A learned deviation
    starts from ``std``.

    Attributes:
        value: All parameters, float32 ``[P]``; writing to it writes to the policy.
        grad: All gradients, float32 ``[P]``.
        log_std: Float32 ``[A]``.

    Source: section 5 and table 3 of the paper.
    """

    def __init__(
        self,
        sizes: tuple[int, ...],
        *,
        layer_norm: bool,
        init: Init,
        std: float,
        learns_std: bool,
        generator: torch.Generator,
    ) -> None:
        form = Form(sizes, activation="tanh", layer_norm=layer_norm)
        network = form.draw(1, generator, init=init, output_gain=0.01)
        self.log_std = torch.full(sizes[-1:], math.log(std))
        self.learns_std = learns_std
        self.value = torch.cat([self.log_std, network]) if learns_std else network
        self.grad = torch.zeros_like(self.value)
        start = len(self.value) - len(network)
        if learns_std:
            self.log_std = self.value[:start]
        self.network = Ensemble(form, self.value[start:], self.grad[start:], single=True)

    def __call__(self, obs: Tensor) -> Tensor:
        """Mean action, canonical, of normalised observations: ``[N, D]`` to ``[N, A]``."""
        return self.network(obs)

    def trace(self, obs: Tensor) -> tuple[Tensor, Tape]:
        """Map as a call does, and keep what `differentiate` needs."""
        return self.network.trace(obs)

    def differentiate(self, tape: Tape, grad_mean: Tensor, grad_log_std: Tensor) -> None:
        """Overwrite the gradients of all parameters, with a tape from `trace`.

        The gradient of the loss by the means is ``[N, A]``, that by the log standard deviation
        ``[A]``; the latter is not used when the deviation is fixed.
        """
        self.network.differentiate(tape, grad_mean)
        if self.learns_std:
            self.grad[: len(grad_log_std)] = grad_log_std

    def std(self) -> Tensor:
        """Standard deviation, ``[A]``."""
        return self.log_std.exp()
