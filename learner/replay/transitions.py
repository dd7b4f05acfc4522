"""What sampling a replay gives: transitions over n steps, ready for an off-policy update."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from a2s.protocol.fields import Array

Rows = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Transitions:
    """A batch of transitions, each over up to n steps of one episode.

    The target of a value at ``(obs, action)`` is ``reward + discount * value(next_obs)``.

    Attributes:
        obs: Observation before the first step, float32 ``[B, D]``.
        action: The first step's executed suggestion, canonical, not clipped, float32 ``[B, A]``.
        reward: Discounted sum of the rewards of the steps, float32 ``[B]``.
        next_obs: Observation after the last step, of the same episode, float32 ``[B, D]``.
        discount: gamma to the number of steps; 0 where the last one terminated, float32 ``[B]``.
        weight: Importance weight, highest of the batch 1; all 1 when drawn uniformly,
            float32 ``[B]``.
        row: Number of the first step's row, counted from the first ever inserted, int64 ``[B]``.
        begin: Number of the oldest row when it was drawn.
        end: Number of the row that was to come next.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    discount: Array
    weight: Array
    row: Rows
    begin: int
    end: int
