"""The robot that robot_actor.py plays: put yours in its place."""

import random

import numpy as np
import numpy.typing as npt

NAME, LOW, HIGH, OBS_SIZE = "Robot", [-1.0], [1.0], 2


class Robot:
    """A cart that a force pushes to the origin, in steps of 0.05 s, for 10 s an episode."""

    max_steps = 200

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def reset(self) -> npt.NDArray[np.float64]:
        """Begin an episode."""
        self._place, self._speed, self._steps = self._random.uniform(-1, 1), 0.0, 0
        return np.array([self._place, self._speed])

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float64], float, bool, bool]:
        """Act for one step: observation, reward, terminated, truncated."""
        self._speed += 0.05 * float(action[0])
        self._place += 0.05 * self._speed
        self._steps += 1
        is_lost = abs(self._place) > 3
        obs = np.array([self._place, self._speed])
        return obs, -abs(self._place), is_lost, self._steps >= self.max_steps and not is_lost
