"""The policy of off-policy A2S: a Gaussian squeezed into the bounds by tanh.

``u = mean + std * normal`` and ``a = tanh(u)``, mean and standard deviation of every dimension
depending on the state. ``u`` is what is drawn, ``a`` the suggestion, canonical in -1..1.

Source: Haarnoja et al. 2018 (SAC), appendix C. Their code lets the log standard deviation fall to
-20, where a score function or equation 6, which divide by it, would be lost to rounding.
"""

import math
from typing import NamedTuple

import torch.nn.functional as F  # noqa: N812
from torch import Tensor

LOG_STD_LEAST, LOG_STD_MOST = -10.0, 2.0
LOG_NORM = 0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0)


class Gaussian(NamedTuple):
    """The distribution of u.

    Attributes:
        mean: ``[B, A]``.
        log_std: Within its range, ``[B, A]``.
        free: 1 where the log standard deviation is within its range, 0 where it is held at an
            end of it and has no gradient, ``[B, A]``.
    """

    mean: Tensor
    log_std: Tensor
    free: Tensor


def gaussian(output: Tensor) -> Gaussian:
    """Read the output of the policy network, ``[B, 2 A]``: means, then log deviations."""
    mean, raw = output.chunk(2, dim=-1)
    log_std = raw.clamp(LOG_STD_LEAST, LOG_STD_MOST)
    return Gaussian(mean, log_std, (raw == log_std).to(raw.dtype))


class Drawn(NamedTuple):
    """One suggestion a state.

    Attributes:
        noise: ``std * normal``, ``[B, A]``.
        action: ``tanh(mean + noise)``, ``[B, A]``.
        log_prob: Its log density, ``[B]``.
    """

    noise: Tensor
    action: Tensor
    log_prob: Tensor


def draw(policy: Gaussian, normal: Tensor) -> Drawn:
    """Suggest one action a state, with noise that was drawn before, ``[B, A]``."""
    noise = policy.log_std.exp() * normal
    u = policy.mean + noise
    return Drawn(noise, u.tanh(), log_density(u, normal, policy.log_std))


def draw_several(policy: Gaussian, normal: Tensor) -> Tensor:
    """Suggest K actions a state, with noise ``[..., B, K, A]``: their u, of the same shape."""
    return policy.mean.unsqueeze(1) + policy.log_std.exp().unsqueeze(1) * normal


def log_density(u: Tensor, normal: Tensor, log_std: Tensor) -> Tensor:
    """Log density of ``tanh(u)``, summed over the action's dimensions.

    Args:
        u: As drawn, ``[..., A]``.
        normal: The noise that it was drawn with, ``[..., A]``.
        log_std: ``[..., A]``.

    Returns:
        ``[...]``. ``log(1 - tanh(u)^2)`` is written ``2 (log 2 - u - softplus(-2 u))``, which is
        exact for large u too.
    """
    half = (u + F.softplus(-2.0 * u)).sub_(log_std, alpha=0.5).addcmul_(normal, normal, value=-0.25)
    return 2.0 * half.sum(-1) - u.shape[-1] * LOG_NORM
