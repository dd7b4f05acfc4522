"""What the learner has to know of a robot that actors of your own play: `--env ./robot.py:Robot`.

The learner makes it once and resets it, for the sizes and bounds and for one typical observation.
"""

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt


class Robot(gymnasium.Env[npt.NDArray[np.float64], npt.NDArray[np.float32]]):
    """Position and velocity of a cart; the action is a force."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
        """Give a typical first observation."""
        super().reset(seed=seed)
        return np.array([1.0, 0.0]), {}
