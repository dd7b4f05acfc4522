"""The policy of off-policy A2S: a Gaussian squeezed into the bounds by tanh.

``u = mean + std * normal`` and ``a = tanh(u)``, mean and standard deviation of every dimension
depending on the state. ``u`` is what is drawn, ``a`` the suggestion, canonical in -1..1.

Source: Haarnoja et al. 2018 (SAC), appendix C. Their code lets the log standard deviation fall to
-20, where a score function or equation 6, which divide by it, would be lost to rounding.
"""

from typing import NamedTuple

from torch import Tensor

from a2s.learner.networks.gaussian import log_density

LOG_STD_LEAST, LOG_STD_MOST = -10.0, 2.0


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
    return Drawn(noise, u.tanh(), log_density(normal, policy.log_std, u))


def draw_several(policy: Gaussian, normal: Tensor) -> Tensor:
    """Suggest K actions a state, with noise ``[..., B, K, A]``: their u, of the same shape."""
    return policy.mean.unsqueeze(1) + policy.log_std.exp().unsqueeze(1) * normal
