"""What one off-policy update consumes."""

from typing import NamedTuple

from torch import Tensor


class Transitions(NamedTuple):
    """Rows of a replay: a step each, or n steps of one episode summed up.

    Attributes:
        obs: Observations as the environment gave them, float32 ``[B, D]``.
        action: Executed actions, canonical in -1..1, float32 ``[B, A]``.
        reward: ``r_0 + gamma r_1 + ...`` over the n steps, float32 ``[B]``.
        next_obs: The observation after them, of the same episode, float32 ``[B, D]``.
        discount: ``gamma ** n``, float32 ``[B]``; 0 where a terminal state was reached, but not
            where a time limit cut the episode.
        weight: Importance weights of the sampling, float32 ``[B]``; 1 where it is uniform.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    discount: Tensor
    weight: Tensor
