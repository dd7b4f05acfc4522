"""Critics that say how likely each of a row of values is: what they learn, and their mean.

Source: Imani and White 2018 (HL-Gauss); Farebrother et al. 2024, "Stop regressing".
"""

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from a2s.learner.networks.compiled import run_together
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy import fit_kernels

_ROWS_AT_ONCE = 512
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


@torch.no_grad()
def score(q_net: Ensemble, norm_obs: Tensor, action: Tensor) -> Tensor:
    """Mean of all members' expected values, ``[N, D]`` and ``[N, K, A]`` to ``[N, K]``."""
    into = np.zeros((q_net.members, action.shape[0] * action.shape[1]), np.float32)
    room = max(_ROWS_AT_ONCE // action.shape[1], 1)
    value, obs = q_net.value.numpy(), norm_obs.contiguous().numpy()
    flat, middle = action.flatten(0, 1).contiguous().numpy(), centres(norm_obs).numpy()
    run_together(
        [
            partial(
                fit_kernels.expected, value, q_net.form.layout(q_net.members, member), obs, flat,
                middle, room, into[member],
            )
            for member in range(q_net.members)
        ]
    )  # fmt: skip
    return torch.from_numpy(into.mean(0)).view(action.shape[:2])
