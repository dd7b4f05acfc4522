"""Critics that say how likely each of a row of values is: what they learn, and their mean.

Source: Imani and White 2018 (HL-Gauss); Farebrother et al. 2024, "Stop regressing".
"""

import math

import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble

BINS, HALF_RANGE = 51, 12.0
WIDTH = 2.0 * HALF_RANGE / (BINS - 1)
_SIGMA = 0.75 * WIDTH


def centres(like: Tensor) -> Tensor:
    """The values, evenly from ``-HALF_RANGE`` to ``HALF_RANGE``, ``[BINS]``."""
    return torch.linspace(-HALF_RANGE, HALF_RANGE, BINS, dtype=like.dtype, device=like.device)


def spread(target: Tensor) -> Tensor:
    """Chances of a normal distribution around each target, ``[N]`` to ``[N, BINS]``, sums 1.

    Its deviation is 3/4 of a bin; targets are limited to the range.
    """
    edges = torch.linspace(
        -HALF_RANGE - WIDTH / 2, HALF_RANGE + WIDTH / 2, BINS + 1, device=target.device
    )
    limited = target.clamp(-HALF_RANGE, HALF_RANGE).unsqueeze(-1)
    below = torch.erf((edges - limited) / (_SIGMA * math.sqrt(2.0)))
    chance = below.diff(dim=-1)
    return chance / chance.sum(-1, keepdim=True)


def mean(logits: Tensor) -> Tensor:
    """Expected value, ``[..., BINS]`` to ``[...]``."""
    return logits.softmax(-1) @ centres(logits)


def score(q_net: Ensemble, norm_obs: Tensor, action: Tensor) -> Tensor:
    """Mean of all members' expected values, ``[N, D]`` and ``[N, K, A]`` to ``[N, K]``."""
    logits = q_net.outputs(norm_obs, action.expand(q_net.members, *action.shape))
    return mean(logits).mean(0)


def loss_and_slope(logits: Tensor, chance: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy, mean over rows and sum over members, and its gradient by the logits.

    Logits ``[E, N, BINS]``, chances ``[N, BINS]``.
    """
    log_chance = logits.log_softmax(-1)
    rows = logits.shape[-2]
    loss = -(chance * log_chance).sum() / rows
    return loss, (log_chance.exp() - chance) / rows
