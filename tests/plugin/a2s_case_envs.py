"""Environments that have the traits of other people's; importing this module registers them.

``a2s_case_envs:Control-v0`` has none: three float32 observations, one action in -1..1, episodes of
100 steps, reward -|action - 0.5|, and nothing is drawn. Every other one here is the control with
one trait, so that what is played and learned must be the same, to the bit. Those with other
numbers are in ``a2s_case_numbers``, those that are wrong in ``a2s_case_mistakes``, and those that
do something to their process in ``a2s_case_processes``.
"""

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Obs = npt.NDArray[Any]
Step = tuple[Obs, float, bool, bool, dict[str, Any]]
Change = Callable[[Any], Any]


class Control(gymnasium.Env[Obs, Obs]):
    """The environment without a trait.

    Args:
        length: Steps of an episode; 0: it never ends.
        scale: Observations are times this.
        offset: And this is added.
        dtype: Of the observations.
        reward_scale: Rewards are times this.
    """

    def __init__(
        self,
        length: int = 100,
        scale: float = 1.0,
        offset: float = 0.0,
        dtype: str = "float32",
        reward_scale: float = 1.0,
    ) -> None:
        self.observation_space: spaces.Space[Any] = spaces.Box(
            -np.inf, np.inf, (3,), np.dtype(dtype).type
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.length, self._scale, self._offset, self._dtype = length, scale, offset, dtype
        self._reward_scale = reward_scale
        self.at, self.last = 0, 0.0

    def obs(self) -> Obs:
        numbers = np.array([self.at / 100, self.last, math.cos(self.at / 10)], dtype=np.float32)
        return (numbers.astype(np.float64) * self._scale + self._offset).astype(self._dtype)

    def begin(self) -> Obs:
        self.at, self.last = 0, 0.0
        return self.obs()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        return self.begin(), {}

    def step(self, action: Obs) -> Step:
        self.at, self.last = self.at + 1, float(action.reshape(-1)[0])
        reward = -abs(self.last - 0.5) * self._reward_scale
        return self.obs(), reward, False, self.at == self.length, {}


class InPlace(Control):
    """Has one array for all its observations, and fills it in reset and step."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._buffer = np.zeros(3, dtype=self._dtype)

    def obs(self) -> Obs:
        self._buffer[:] = super().obs()
        return self._buffer


class View(Control):
    """Its observations are a part of its state, which goes on."""

    def __init__(self) -> None:
        super().__init__()
        self._state = np.zeros((2, 6), dtype=np.float32)

    def obs(self) -> Obs:
        self._state[0, ::2] = super().obs()
        return self._state[0, ::2]


class SpoiltByReset(Control):
    """Its reset overwrites the observation that ended the last episode."""

    def obs(self) -> Obs:
        self._given = super().obs()
        return self._given

    def begin(self) -> Obs:
        if self.at:
            self._given[:] = -99.0
        return super().begin()


class RewardBuffer(Control):
    """Has one array for its rewards, and is another number by the next step."""

    def __init__(self) -> None:
        super().__init__()
        self._reward = np.zeros(1)

    def step(self, action: Obs) -> Any:
        obs, self._reward[0], *rest = super().step(action)
        return obs, self._reward, *rest


class Changed(Control):
    """Gives ``step`` of what its step should give, from the ``at``-th on, or ``reset`` of that."""

    def __init__(
        self, step: Change | None = None, reset: Change | None = None, at: int = 1
    ) -> None:
        super().__init__()
        self._change_step, self._change_reset, self._before = step, reset, at

    def reset(self, **_: Any) -> Any:
        result: Any = self.begin(), {}
        return self._change_reset(result) if self._change_reset else result

    def step(self, action: Obs) -> Any:
        result = super().step(action)
        self._before -= 1
        return self._change_step(result) if self._change_step and self._before <= 0 else result


_FORMS: dict[str, Change] = {
    "reward of one": lambda s: (s[0], np.array([s[1]]), *s[2:]),
    "reward of one by one": lambda s: (s[0], np.array([[s[1]]]), *s[2:]),
    "reward without dimension": lambda s: (s[0], np.array(s[1]), *s[2:]),
    "reward in a list": lambda s: (s[0], [s[1]], *s[2:]),
    "bool of numpy": lambda s: (*s[:2], np.bool_(s[2]), np.bool_(s[3]), {}),
    "ends as integers": lambda s: (*s[:2], int(s[2]), int(s[3]), {}),
    "a list of five": list,
    "a row": lambda s: (s[0][None, :], *s[1:]),
    "a column": lambda s: (s[0][:, None], *s[1:]),
    "float64": lambda s: (s[0].astype(np.float64), *s[1:]),
    "list": lambda s: (s[0].tolist(), *s[1:]),
    "tuple": lambda s: (tuple(s[0].tolist()), *s[1:]),
}


class NoSeed(Control):
    """Its reset takes nothing."""

    def reset(self) -> Any:  # type: ignore[override]
        return self.begin(), {}


class OnlySeed(Control):
    """Its reset takes a seed, and no options."""

    def reset(self, seed: int | None = None) -> Any:  # type: ignore[override]
        return self.begin(), {}


class OnlyOptions(Control):
    """Its reset takes options, and no seed; what it gives is a list."""

    def reset(self, options: dict[str, Any] | None = None) -> Any:  # type: ignore[override]
        return [self.begin(), {}]


class MutatesAction(Control):
    """Clips and scales the action in the array that it was given."""

    def step(self, action: Obs) -> Step:
        result = super().step(action)
        action *= 0.0
        return result


class KeepsAction(Control):
    """Keeps the arrays of all actions, and looks whether somebody else writes into them."""

    def __init__(self) -> None:
        super().__init__()
        self._kept: list[tuple[Obs, float]] = []

    def step(self, action: Obs) -> Step:
        self._kept.append((action, float(action[0])))
        if any(float(array[0]) != value for array, value in self._kept):
            raise AssertionError("somebody wrote into an action that was given away")
        return super().step(action)


class Tolerated(InPlace):
    """Most of it at once; changes the working directory to ``there``, and cannot be closed."""

    def __init__(self, there: str) -> None:
        super().__init__()
        Path(there).mkdir(parents=True, exist_ok=True)
        os.chdir(there)

    def reset(self) -> Any:  # type: ignore[override]
        return [self.begin(), {}]

    def step(self, action: Obs) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        action[:] = 7.0
        return obs[None, :], np.array([[reward]]), np.bool_(terminated), np.bool_(truncated), info

    def close(self) -> None:
        raise RuntimeError("there is nothing to close")


class Slow(Control):
    """Takes its time to be made and to be reset."""

    def __init__(self, make_s: float, reset_s: float) -> None:
        super().__init__()
        time.sleep(make_s)
        self._reset_s = reset_s

    def begin(self) -> Obs:
        time.sleep(self._reset_s)
        self._reset_s = 0.0
        return super().begin()


def register(name: str, entry: Any, **kwargs: Any) -> None:
    """Make it known as ``NAME-v0``, with no limit of its own."""
    gymnasium.register(f"{name}-v0", entry_point=entry, kwargs=kwargs)


FORMS = {"Form" + form.title().replace(" ", ""): change for form, change in _FORMS.items()}
for _name, _change in FORMS.items():
    register(_name, Changed, step=_change)
SAME_AS_CONTROL = (
    "InPlace", "InPlace64", "View", "SpoiltByReset", "RewardBuffer", *FORMS, "NoSeed", "OnlySeed",
    "OnlyOptions", "MutatesAction", "KeepsAction",
)  # fmt: skip
for _class in (
    Control, InPlace, View, SpoiltByReset, RewardBuffer, NoSeed, OnlySeed, OnlyOptions,
    MutatesAction, KeepsAction, Tolerated, Slow,
):  # fmt: skip
    register(_class.__name__, _class)
register("InPlace64", InPlace, dtype="float64")
register("Endless", Control, length=0)
