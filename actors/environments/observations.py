"""Observations as the run uses them: a copy in flat float32, with frames stacked and an offset."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim

from a2s.actors.environments.faults import Faults
from a2s.protocol.fields import Array, is_within
from a2s.protocol.messages import MAX_PLAYED

_FLOAT32, _FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)
_Float64s = npt.NDArray[np.float64]

# The caller reports numbers too large for float32, and names the environment.
warnings.filterwarnings("ignore", "overflow encountered in cast", RuntimeWarning)


class Observations:
    """Reads the observations of one environment, in any shape, dtype or kind of sequence.

    Each has ``size`` numbers; the latest ``frame_stack`` are given at once, the newest last. One
    that cannot be used is in no later stack of its episode. ``env`` has all wrappers; ``offset``,
    float32 ``[frame_stack * size]``, is subtracted.
    """

    def __init__(
        self,
        faults: Faults,
        env: "gymnasium.Env[Any, Any]",
        size: int,
        frame_stack: int,
        offset: Array | None,
    ) -> None:
        self._faults, self._env = faults, env
        self._space = env.observation_space
        self._size, self._shape = size, (size * frame_stack,)
        self._stack = frame_stack
        self._offset = 0.0 if offset is None else offset.astype(np.float64)
        self._is_direct = (
            frame_stack == 1 and offset is None and isinstance(self._space, spaces.Box)
        )
        self._frames: list[_Float64s] = []

    def read(self, call: str, obs: Any) -> Array:
        """Copy the observation of ``reset`` or ``step``: float32 ``[frame_stack * size]``.

        Raises:
            FaultyEnvironmentError: It does not have that many numbers.
        """
        try:
            found = self._float32(call, obs)
        except Exception:  # noqa: BLE001  # a user's object may raise anything
            found = self._quietly(call, obs)
        if found.shape == self._shape:
            return found
        if obs is None or found.size != self._shape[0]:
            raise self._faults.misfit(self._env, call, obs, self._size)
        return found.reshape(self._shape)

    def exact(self, obs: Any) -> _Float64s:
        """Give ``obs``, which was read last, before the conversion to float32."""
        return np.concatenate(self._frames or [_numbers(self._space, obs)])

    def _float32(self, call: str, obs: Any) -> Array:
        if self._is_direct:
            if type(obs) is np.ndarray:
                return obs.astype(_FLOAT32)
            found: Array = _unmasked(obs, _FLOAT32)
            return found
        frame = _numbers(self._space, obs)
        if frame.size != self._size:
            raise ValueError
        frames = [frame] * self._stack if call == "reset" else [*self._frames[1:], frame]
        result: Array = (np.concatenate(frames) - self._offset).astype(_FLOAT32)
        if call == "reset" or is_within(result, MAX_PLAYED):  # who goes on, goes on without it
            self._frames = frames
        return result

    def _quietly(self, call: str, obs: Any) -> Array:
        """Read it even if the environment has turned warnings into errors."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
                return self._float32(call, obs)
        except Exception as error:  # noqa: BLE001  # a user's object may raise anything
            raise self._faults.misfit(self._env, call, obs, self._size, error) from None


def _numbers(space: "spaces.Space[Any]", value: Any) -> _Float64s:
    """Flatten a value in the order of its space; a Box's dtype does not round it."""
    if isinstance(space, spaces.Dict):
        return np.concatenate([_numbers(part, value[key]) for key, part in space.items()])
    if isinstance(space, spaces.Tuple):
        parts = zip(space.spaces, value, strict=True)
        return np.concatenate([_numbers(part, x) for part, x in parts])
    if not isinstance(space, spaces.Box):
        _require_within(space, value)
        value = spaces.flatten(space, value)
    numbers: _Float64s = _unmasked(value, _FLOAT64).reshape(-1)
    if numbers.size != flatdim(space):
        raise ValueError("another count")
    return numbers


def _unmasked(value: Any, dtype: "np.dtype[Any]") -> npt.NDArray[Any]:
    """Copy numbers; one under a mask is none."""
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.filled(value.astype(dtype), np.nan)
    return np.array(value, dtype)


def _require_within(space: "spaces.Space[Any]", value: Any) -> None:
    """Refuse numbers that are not valid classes; one-hot, they would count as others."""
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        count = space.n if isinstance(space, spaces.Discrete) else space.nvec
        index = np.asarray(value) - space.start
        if np.size(value) != np.size(count) or ((index < 0) | (index >= count)).any():
            raise ValueError("out of range")
