"""Every random choice of one off-policy update, drawn beforehand."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.off_policy.config import OffPolicyConfig


class Noise(NamedTuple):
    """What an update draws.

    Attributes:
        suggestion: Standard normal, for the suggestion that the pathwise gradient moves,
            ``[B, A]``.
        target: Standard normal, for the suggestions in the next states, ``[N, B, K_target, A]``.
        distil: Standard normal, for those of the loss ``score``, ``[B, K, A]``; K is 0 where
            nothing reads them.
        critic: Number of the online critic that selects: in each group, then among ``distil``,
            int64 ``[N + 1]``.
    """

    suggestion: Tensor
    target: Tensor
    distil: Tensor
    critic: Tensor


def draw_noise(
    rows: int, action_size: int, hyper: OffPolicyConfig, generator: torch.Generator
) -> Noise:
    """Draw the noise of an update of B = ``rows`` rows."""
    groups = hyper.target_groups
    several = max(2, hyper.act_suggestions) if hyper.policy_loss == "score" else 0

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    return Noise(
        suggestion=normal(rows, action_size),
        target=normal(groups, rows, hyper.target_suggestions, action_size),
        distil=normal(rows, several, action_size),
        critic=torch.randint(hyper.num_critics, (groups + 1,), generator=generator),
    )
