"""Environments whose numbers and spaces are those of other people; importing registers them."""

import functools
import json
import os
import random
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from a2s_case_envs import Control, Obs, Step, register
from gymnasium import spaces

THIRD = 1.0 / 3.0  # between two float32; the nearest of them lies outside
FLOAT_MAX = float(np.finfo(np.float32).max)


class Strict(Control):
    """Takes actions of its own type within its own bounds, and fails otherwise.

    Args:
        low: Of the action.
        high: Of the action.
        dtype: Of the bounds.
        notes: File to which every action is added.
    """

    def __init__(
        self,
        low: Any = -0.1,
        high: Any = 0.1,
        dtype: str = "float64",
        notes: str | None = None,
    ) -> None:
        super().__init__()
        self._low, self._high = (np.atleast_1d(np.array(b, dtype=dtype)) for b in (low, high))
        self.action_space = spaces.Box(self._low, self._high, dtype=np.dtype(dtype).type)
        self._notes = notes

    def step(self, action: Obs) -> Step:
        if action.dtype != self._low.dtype or action.shape != self._low.shape:
            raise AssertionError(f"found {action.dtype} {action.shape}")
        if not ((self._low <= action) & (action <= self._high)).all():
            raise AssertionError(f"found {action!r}, which is not within the bounds")
        if self._notes:
            with Path(self._notes).open("a") as file:
                file.write(f"{action.reshape(-1)[0]}\n")
        return super().step(action)


class Matrix(Control):
    """Observations and actions of two by two."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
        low = np.array([[-1.0, -2.0], [-3.0, -4.0]])
        self.action_space = spaces.Box(low, np.full((2, 2), 5.0), dtype=np.float64)

    def obs(self) -> Obs:
        return np.array([[self.at, self.last], [2.0, 3.0]])

    def step(self, action: Obs) -> Step:
        if action.shape != (2, 2):
            raise AssertionError(f"found an action of shape {action.shape}")
        return super().step(action)


class Composite(Control):
    """A Dict with a Tuple, a Discrete and an integer Box in it."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Dict(
            {
                "velocity": spaces.Box(-9.0, 9.0, (2,), np.float64),
                "gear": spaces.Discrete(3, start=1),
                "arm": spaces.Tuple((spaces.Box(-9, 9, (2, 1), np.int16), spaces.MultiBinary(2))),
            }
        )

    def obs(self) -> Any:
        return {
            "velocity": np.array([0.25, -0.5]),
            "gear": 1 + self.at % 3,
            "arm": (np.array([[7], [8]], dtype=np.int16), np.array([0, 1], dtype=np.int8)),
        }


class Inexact(Control):
    """Says integers, in a Dict or alone, and gives fractions; rewards are arrays of one."""

    def __init__(self, nested: bool) -> None:
        super().__init__(dtype="float64")
        self._nested = nested
        box = spaces.Box(-1000, 1000, (3,), np.int64)
        self.observation_space = spaces.Dict({"only": box}) if nested else box

    def obs(self) -> Any:
        return {"only": super().obs()} if self._nested else super().obs()

    def step(self, action: Obs) -> Any:
        obs, reward, *rest = super().step(action)
        return obs, np.array([reward]), *rest


class NoClass(Control):
    """Observes a class that there is none of, or hides a number under a mask.

    Args:
        space: ``discrete``, ``multi`` or ``masked``.
    """

    def __init__(self, space: str) -> None:
        super().__init__()
        self._space = space
        if space == "discrete":
            self.observation_space = spaces.Discrete(3)
        elif space == "multi":
            self.observation_space = spaces.MultiDiscrete([3, 3])

    def obs(self) -> Any:
        if self._space == "masked":
            return np.ma.masked_array(super().obs(), mask=[False, self.at == 2, False])
        index = -1 if self.at == 2 else 2
        return np.int64(index) if self._space == "discrete" else np.array([0, index])


class Named(Control):
    """Has arguments that Gymnasium's own functions have too; and one that is a C integer."""

    def __init__(self, max_episode_steps: int = 0, id: str = "") -> None:  # noqa: A002
        super().__init__()
        self.told = max_episode_steps, id

    def reset(self, **kwargs: Any) -> Any:
        assert (kwargs["seed"] or 0) < 2**31
        return super().reset(**kwargs)


make_anonymously = lambda: Control()  # noqa: E731
make_in_part = functools.partial(Control, length=7)


class Broken(Control):
    """One number in ``every`` steps is ``value``.

    Args:
        what: ``obs`` (its number 1) or ``reward``.
        value: Of it.
        every: Steps from one to the next.
        ends: The broken step ends the episode, and costs 10.
        dtype: Of the observations.
    """

    def __init__(
        self, what: str = "obs", value: float = np.nan, every: int = 97, ends: str = "",
        dtype: str = "float32",
    ) -> None:  # fmt: skip
        super().__init__(dtype=dtype)
        self._what, self._value, self._every, self._ends = what, value, every, ends
        self._steps = 0

    def step(self, action: Obs) -> Step:
        obs, reward, terminated, truncated, info = super().step(action)
        self._steps += 1
        if self._steps % self._every == 0:
            if self._what == "reward":
                reward = self._value
            else:
                obs[1] = self._value
            if self._ends:
                terminated, truncated = self._ends == "terminated", self._ends == "truncated"
                reward = -10.0
        return obs, reward, terminated, truncated, info


class BrokenFrom(Control):
    """Number 1 of all observations is no number from a step on, whatever episode it is in."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._left = first

    def obs(self) -> Obs:
        obs = super().obs()
        if self._left <= 0:
            obs[1] = np.nan
        return obs

    def step(self, action: Obs) -> Step:
        self._left -= 1
        return super().step(action)


class Wide(Control):
    """Very many numbers, which differ from step to step, and no end."""

    def __init__(self, size: int) -> None:
        super().__init__(length=0)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self._size = size

    def obs(self) -> Obs:
        return np.full(self._size, self.at % 100 / 100, dtype=np.float32)


class GlobalRandom(Control):
    """Draws by the modules, in the constructor unless that draws nothing, in reset and in step."""

    def __init__(self, made_by_chance: bool = True) -> None:
        super().__init__()
        self._gain = 1.0
        if made_by_chance:
            self._gain = np.random.uniform(0.5, 1.5) * random.uniform(0.5, 1.5)  # noqa: NPY002

    def begin(self) -> Obs:
        self._phase = random.random() + np.random.normal()  # noqa: NPY002
        return super().begin()

    def obs(self) -> Obs:
        noise = np.random.normal(size=3) * 0.1 + random.gauss(0.0, 0.1)  # noqa: NPY002
        return (super().obs() * self._gain + self._phase + noise).astype(np.float32)


class NoSeedRandom(GlobalRandom):
    """The same, with a reset that takes no seed."""

    def reset(self) -> Any:  # type: ignore[override]
        return self.begin(), {}


class Success(Composite):
    """Tells at the end of an episode how it went, and other things; observes many things."""

    def __init__(self) -> None:
        super().__init__()
        self.length, self._episode = 50, 0

    def begin(self) -> Obs:
        self._episode += 1
        return super().begin()

    def step(self, action: Obs) -> Step:
        obs, reward, terminated, truncated, _ = super().step(action)
        info: dict[str, Any] = {
            "distance": np.float32(0.25), "words": "left", "reading": np.zeros(4),
        }  # fmt: skip
        if self.at == self.length:
            info["is_success"] = self._episode % 2 == 0
        return obs, reward, terminated, truncated, info


class Spaces(Control):
    """Has the spaces it is told to have."""

    def __init__(self, obs: spaces.Space[Any] | None = None, act: Any = None) -> None:
        super().__init__()
        self.observation_space = obs or self.observation_space
        self.action_space = act or self.action_space


class Recorder(Control):
    """Writes down what it was made with, and what was done to it.

    Args:
        notes: File to which lines are added.
        port: Any number, or text.
        **others: Whatever else there is.
    """

    def __init__(self, notes: str, port: Any = None, **others: Any) -> None:
        super().__init__()
        made = {"port": port, **others}
        made |= {name: os.environ.get(name) for name in ("A2S_WORKER", "A2S_ENV_INDEX")}
        with Path(notes).open("a") as file:
            file.write(json.dumps(made) + "\n")


class Shift(gymnasium.Wrapper[Obs, Obs, Obs, Obs]):
    """Adds to the observations, multiplies the rewards."""

    def __init__(self, env: gymnasium.Env[Obs, Obs], by: float = 1.0, times: float = 1.0) -> None:
        super().__init__(env)
        self._by, self._times = np.float32(by), times

    def reset(self, **kwargs: Any) -> tuple[Obs, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        return obs + self._by, info

    def step(self, action: Obs) -> Any:
        obs, reward, *rest = self.env.step(action)
        return obs + self._by, float(reward) * self._times, *rest


def _box(low: list[float], high: list[float], dtype: type[np.floating[Any]] = np.float32) -> Any:
    return spaces.Box(np.array(low, dtype=dtype), np.array(high, dtype=dtype), dtype=dtype)


_MANY = np.arange(1.0, 31.0, dtype=np.float32)
UNSUPPORTED: dict[str, tuple[dict[str, Any], str]] = {
    "Widest": ({"act": _box([-FLOAT_MAX], [FLOAT_MAX])}, r"action 0 has bounds -3\.40282e\+38 to"),
    "WidestSecond": (
        {"act": _box([-1.0, -FLOAT_MAX], [1.0, FLOAT_MAX])},
        r"action 1 has bounds -3\.40282e\+38 to 3\.40282e\+38",
    ),
    "WidestDouble": (
        {"act": _box([-1e308, -1.0], [1e308, 1.0], np.float64)}, r"action 0 has bounds -1e\+308",
    ),
    "SameBounds": ({"act": _box([-1.0, 0.5], [1.0, 0.5])}, r"action 1 has bounds 0\.5 to 0\.5"),
    "InfiniteSecond": (
        {"act": _box([-1.0, -np.inf], [1.0, np.inf])}, r"action 1 has bounds -inf to inf",
    ),
    "Buttons": ({"act": spaces.Discrete(4)}, r"Discrete\(4\)"),
    "ManyButtons": ({"act": spaces.MultiDiscrete([3] * 60)}, r"MultiDiscrete\("),
    "Switches": ({"act": spaces.MultiBinary(4)}, r"MultiBinary\(4\)"),
    "Image": ({"obs": spaces.Box(0, 255, (84, 84, 3), np.uint8)}, r"\(84, 84, 3\)"),
    "ImageInDict": (
        {"obs": spaces.Dict({"camera": spaces.Box(0, 255, (64, 64, 3), np.uint8)})},
        r"\(64, 64, 3\)",
    ),
    "Words": ({"obs": spaces.Text(9)}, r"Text"),
    "Several": ({"obs": spaces.Sequence(spaces.Box(-_MANY, _MANY))}, r"Sequence"),
}  # fmt: skip
BROKEN: dict[str, dict[str, Any]] = {
    "Broken": {},
    "BrokenInf": {"value": -np.inf},
    "BrokenMost": {"value": FLOAT_MAX},
    "BrokenDouble": {"value": 1e300, "dtype": "float64"},
    "BrokenReward": {"what": "reward"},
    "BrokenRewardInf": {"what": "reward", "value": np.inf},
    "BrokenRewardMost": {"what": "reward", "value": 1e300},
}
for _name, (_spaces, _) in UNSUPPORTED.items():
    register(_name, Spaces, **_spaces)
for _class in (Strict, Matrix, Composite, Named, Wide, GlobalRandom, Success, Recorder):
    register(_class.__name__, _class)
register("StrictThird", Strict, low=-THIRD, high=THIRD)
register("StrictSkewed", Strict, low=0.1, high=THIRD)
register("Integers", Strict, low=-1, high=1, dtype="int32")
register("IntegersUnsigned", Strict, low=0, high=3, dtype="uint8")
for _space in ("discrete", "multi", "masked"):
    register(f"NoClass{_space.capitalize()}", NoClass, space=_space)
register("Inexact", Inexact, nested=False)
register("InexactDict", Inexact, nested=True)
for _name, _broken in BROKEN.items():
    register(_name, Broken, **_broken)
register("BrokenAlways", Broken, every=1)
register("BrokenFrom51", BrokenFrom, first=51)
for _ends in ("terminated", "truncated"):
    register(f"BrokenEnd{_ends.capitalize()}", Broken, ends=_ends)
    register(f"BrokenEnd{_ends.capitalize()}Inf", Broken, ends=_ends, value=np.inf)
register("Wide4096", Wide, size=4096)
register("Wide100000", Wide, size=100_000)
register("StepRandom", GlobalRandom, made_by_chance=False)
register("NoSeedRandom", NoSeedRandom, made_by_chance=False)
