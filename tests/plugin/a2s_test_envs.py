"""Small environments whose every number is known; importing this module registers them.

``a2s_test_envs:Count-v0``: the observation is (episode number, step within the episode), so
that rows which are rolled, shifted or mixed between episodes show.
"""

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Obs = npt.NDArray[Any]


class Count(gymnasium.Env[Obs, Obs]):
    """Episodes of ``length`` steps; reward t + 1 in step t; actions are remembered.

    Args:
        length: Steps of an episode.
        terminates: The end is a terminal state, otherwise a time limit.
        dtype: Of the observations.
        nan_at: Step in which the reward is not a number; -1: never.
        nan_episodes: Of so many episodes from the first.
        low: Lowest action.
        high: Highest action.
        reward: Unit of the rewards.
        tells: The number of the step, as ``is_success``.
    """

    def __init__(
        self,
        length: int = 5,
        terminates: bool = True,
        dtype: str = "float64",
        nan_at: int = -1,
        nan_episodes: float = float("inf"),
        low: tuple[float, ...] = (-1.0, 0.5),
        high: tuple[float, ...] = (3.0, 0.75),
        reward: float = 1.0,
        tells: bool = False,
    ) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.dtype(dtype).type)
        self.action_space = spaces.Box(
            np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
        )
        self._length, self._terminates = length, terminates
        self._nan_at, self._nan_episodes = nan_at, nan_episodes
        self._dtype, self._reward, self._tells = dtype, reward, tells
        self._episode, self._step = -1, 0

    def _obs(self) -> Obs:
        return np.array([self._episode, self._step], dtype=self._dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin the next episode."""
        super().reset(seed=seed, options=options)
        self._episode, self._step = self._episode + 1, 0
        return self._obs(), {}

    def step(self, action: Obs) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Count one step; refuses actions outside the bounds."""
        if not self.action_space.contains(action):
            raise ValueError(f"action {action} is outside {self.action_space}")
        is_nan = self._step == self._nan_at and self._episode < self._nan_episodes
        reward = float("nan") if is_nan else self._reward * (self._step + 1)
        self._step += 1
        over = self._step >= self._length
        info = {"is_success": self._step} if self._tells else {}
        return self._obs(), reward, over and self._terminates, over and not self._terminates, info


class Crash(Count):
    """Fails in its third step, whatever it is given."""

    def step(self, action: Obs) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Fail."""
        if self._step == 2:
            raise RuntimeError("the simulator is broken")
        return super().step(action)


class Falls(Count):
    """Every second episode has one step."""

    def reset(self, **how: Any) -> tuple[Obs, dict[str, Any]]:
        obs, info = super().reset(**how)
        self._length = 1 if self._episode % 2 else 5
        return obs, info


class Breaks(Count):
    """From the second episode on, the reward of the third step is not a number."""

    def reset(self, **how: Any) -> tuple[Obs, dict[str, Any]]:
        obs, info = super().reset(**how)
        self._nan_at = 2 if self._episode else -1
        return obs, info


class Spaces(Count):
    """Has the spaces it is told to have."""

    def __init__(self, obs: spaces.Space[Any] | None = None, act: Any = None) -> None:
        super().__init__()
        self.observation_space = obs or self.observation_space
        self.action_space = act or self.action_space


class Reach(gymnasium.Env[Obs, Obs]):
    """One step to an action of 0.6: solvable in seconds; the best return of 8 steps is 8."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed, options=options)
        self._step = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: Obs) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Reward closeness to 0.6."""
        self._step += 1
        reward = 1.0 - abs(float(action[0]) - 0.6)
        return np.zeros(1, dtype=np.float32), reward, False, self._step >= 8, {}


def _register(name: str, entry: Any, **kwargs: Any) -> None:
    gymnasium.register(f"{name}-v0", entry_point=entry, kwargs=kwargs)


_BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
_register("Count", Count)
_register("CountByFunction", lambda: Count())
_register("CountByArray", Count, low=np.array((-1.0, 0.5)))
_register("CountTruncated", Count, terminates=False)
_register("CountFloat32", Count, dtype="float32")
_register("CountWide", Count, low=(-1.0, 0.5, 0.0), high=(3.0, 0.75, 1.0))
_register("CountTiny", Count, reward=1e-6)
_register("NanReward", Count, nan_at=2)
_register("Tells", Count, tells=True)
_register("TellsNan", Count, tells=True, nan_at=2)
_register("PaysMost", Count, length=8, reward=1e9)
_register("NanAlways", Count, nan_at=0)
_register("NanFirst", Count, nan_at=2, nan_episodes=1)
_register("Crash", Crash)
_register("Falls", Falls)
_register("Breaks", Breaks)
_register("Reach", Reach)
_register("DictObs", Spaces, obs=spaces.Dict({"a": _BOX}))
_register("ImageObs", Spaces, obs=spaces.Box(0, 255, (8, 8, 3), np.uint8))
_register("DiscreteAct", Spaces, act=spaces.Discrete(4))
_register("InfiniteAct", Spaces, act=spaces.Box(-np.inf, np.inf, (2,), np.float32))
