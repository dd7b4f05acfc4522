"""Converts Gymnasium's spaces to flat float32 ones, or says in one line why it cannot."""

import inspect
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim

from a2s.protocol.errors import UsageError, one_line
from a2s.protocol.fields import Array, Spaces

_MAX_OBS = 1_000_000
_PARTS = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
_NESTS = (spaces.Dict, spaces.Tuple)

Layout = list[tuple[str, int]]
Env = gymnasium.Env[Any, Any]


def read_spaces(env_id: str, env: Env, frame_stack: int) -> Spaces:
    """Read the spaces of an environment whose layout could be read, with frames stacked.

    Raises:
        UsageError: They are not supported; the line names the nearest supported ones.
    """
    low, high = _bounds(env_id, env)
    size = flatdim(env.observation_space) * frame_stack
    if size > _MAX_OBS:
        raise UsageError(
            f"environment {env_id}: found {size:,} numbers in an observation, expected at most "
            f"{_MAX_OBS:,}; leave some out with a --wrapper"
        )
    return Spaces(obs_size=size, action_low=low, action_high=high)


def read_layout(env_id: str, space: "spaces.Space[Any]", frame_stack: int) -> Layout:
    """Name the parts of stacked flat observations and their sizes, in the order of the numbers.

    Raises:
        UsageError: A part is an image, or cannot be made numbers of a fixed count.
    """
    layout = [(name or "obs", flatdim(part)) for name, part in _parts(env_id, space, "")]
    if frame_stack == 1:
        return layout
    ages = range(frame_stack - 1, -1, -1)
    return [(f"{name}, {age} before", size) for age in ages for name, size in layout]


def _parts(
    env_id: str, space: "spaces.Space[Any]", name: str
) -> list[tuple[str, "spaces.Space[Any]"]]:
    if isinstance(space, _NESTS):
        inner = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        below = f"{name}/" if name else ""
        return [p for key, part in inner for p in _parts(env_id, part, f"{below}{key}")]
    called = f"observation {name!r}" if name else "observations"
    if isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) > 1:
        advice = (
            "learn from numbers instead, where it has an option for them (--env-kwargs), or from "
            "what a --wrapper module:Class makes of the picture"
        )
        if name:
            advice = (
                "leave it out: --wrapper "
                """'gymnasium.wrappers:FilterObservation={"filter_keys": [the others]}'"""
            )
        raise UsageError(
            f"environment {env_id}: found {called} of shape {space.shape} and dtype uint8, an "
            f"image; {advice}"
        )
    if not isinstance(space, _PARTS):
        raise UsageError(
            f"environment {env_id}: found {called} in {one_line(str(space))}; supported are Box, "
            "Discrete, MultiBinary and MultiDiscrete, also in Dict and Tuple: let a --wrapper "
            "module:Class make one of these of it"
        )
    return [(name, space)]


def _bounds(env_id: str, env: Env) -> tuple[Array, Array]:
    """Read the bounds of the actions: in float32, and within those of the environment."""
    space = env.action_space
    if not isinstance(space, spaces.Box):
        instead = _instead(env_id, env)
        raise UsageError(
            f"environment {env_id}: found actions {one_line(str(space))}; supported is "
            f"Box: {instead}"
        )
    low, high = bounds_of(space)
    for index, (a, b) in enumerate(zip(space.low.ravel(), space.high.ravel(), strict=True)):
        span = f"environment {env_id}: action {index} has bounds {a:g} to {b:g}"
        if not (np.isfinite(a) and np.isfinite(b)):
            raise UsageError(
                f"{span}, expected finite ones; set them in a --wrapper module:Class with an "
                "action_space of its own, or with --env-kwargs if it has an option for them"
            )
        with np.errstate(over="ignore"):
            width = high[index] - low[index]
        if not np.isfinite(width):
            raise UsageError(f"{span}, wider than float32 reaches; give it narrower ones")
        if not width > 0:
            raise UsageError(
                f"{span}, expected low below high, apart by more than float32 resolves; leave it "
                "out in a --wrapper module:Class"
            )
    return low, high


def bounds_of(space: spaces.Box) -> tuple[Array, Array]:
    """Give the bounds of flat actions in float32: where that cannot be exact, within its own."""
    return _inwards(space.low.ravel(), np.inf), _inwards(space.high.ravel(), -np.inf)


def _inwards(bounds: npt.NDArray[Any], direction: float) -> Array:
    """Round to float32, never outwards: an environment may refuse values just beyond a bound."""
    with np.errstate(over="ignore"):
        rounded = bounds.astype(np.float32)
        exact = bounds.astype(np.float64)
        outside = rounded > exact if direction < 0 else rounded < exact
        inner = np.nextafter(rounded, np.float32(direction))
    result: Array = np.where(outside, inner, rounded).astype(np.float32)
    return result


def _instead(env_id: str, env: Env) -> str:
    """Name the nearest alternative that works."""
    name = env_id.rpartition(":")[2]
    base = name.rpartition("-v")[0]
    names = f"{base}Continuous-", f"Continuous{base}-"
    found = [known for known in gymnasium.registry if known.startswith(names)]
    if found:
        return f"--env {sorted(found)[-1]} is the same with a Box"
    if "continuous" in inspect.signature(type(env.unwrapped).__init__).parameters:
        return "--env-kwargs continuous=true makes it one"
    if base == "CartPole":
        return "--env InvertedPendulum-v5 is like it with a Box"
    return "let a --wrapper module:Class take a Box and make these actions of it"
