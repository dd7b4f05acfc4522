"""The only door to Gymnasium and MuJoCo: flat Box observations in, Box actions out."""

import importlib
import logging
import warnings
from typing import Any

import gymnasium
import mujoco
import numpy as np

from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Array, Spaces

logger = logging.getLogger(__name__)

_SUPPORTED = "supported are flat Box observations and flat Box actions with finite bounds"


# Otherwise MuJoCo prints and leaves a MUJOCO_LOG.TXT behind, also for outdated models.
mujoco.set_mju_user_warning(lambda words: logger.debug("mujoco: %s", words))


class Environment:
    """One environment that speaks float32.

    Args:
        env_id: A Gymnasium id, or ``module:Id-v0`` for one that a module registers.

    Raises:
        UsageError: There is no such environment, or its spaces are not supported.
    """

    def __init__(self, env_id: str) -> None:
        self._env = _make(env_id)
        self.spaces = _spaces(env_id, self._env)
        self._action_dtype = self._env.action_space.dtype

    def reset(self, seed: int | None = None) -> Array:
        """Begin an episode.

        Args:
            seed: Begins a reproducible series of episodes; ``None`` goes on with the present one.

        Returns:
            The first observation, float32 ``[D]``.
        """
        obs, _ = self._env.reset(seed=seed)
        return np.asarray(obs, dtype=np.float32)

    def step(self, action: Array) -> tuple[Array, float, bool, bool]:
        """Make one step; after the last one of an episode, call :meth:`reset`.

        Args:
            action: In the environment's units, float32 ``[A]``.

        Returns:
            Next observation (float32 ``[D]``, the true final one at an end), reward,
            ``terminated`` and ``truncated``; never both, a terminal state wins.
        """
        obs, reward, terminated, truncated, _ = self._env.step(
            action.astype(self._action_dtype, copy=False)
        )
        cut = bool(truncated) and not terminated
        return np.asarray(obs, dtype=np.float32), float(reward), bool(terminated), cut

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


def describe(env_id: str) -> Spaces:
    """Make the environment once to learn its spaces.

    Raises:
        UsageError: There is no such environment, or its spaces are not supported.
    """
    environment = Environment(env_id)
    environment.close()
    return environment.spaces


def _make(env_id: str) -> "gymnasium.Env[Any, Any]":
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        with warnings.catch_warnings():
            # Gymnasium announces newer versions of an id; the user chose this one.
            warnings.simplefilter("ignore", DeprecationWarning)
            return gymnasium.make(name, disable_env_checker=True)
    except (ImportError, gymnasium.error.Error) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        advice = "; install it, or name another" if isinstance(error, ImportError) else ""
        raise UsageError(f"environment {env_id!r}: {reason}{advice}") from None


def _spaces(env_id: str, env: "gymnasium.Env[Any, Any]") -> Spaces:
    obs_space, action_space = env.observation_space, env.action_space
    for what, space in (("observations", obs_space), ("actions", action_space)):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise UsageError(f"environment {env_id!r}: found {what} {space}; {_SUPPORTED}")
    assert isinstance(action_space, gymnasium.spaces.Box)
    low, high = (np.asarray(b, dtype=np.float32) for b in (action_space.low, action_space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise UsageError(
            f"environment {env_id!r}: found action bounds {low.tolist()} to {high.tolist()}; "
            f"{_SUPPORTED}"
        )
    assert obs_space.shape is not None
    return Spaces(obs_size=int(obs_space.shape[0]), action_low=low, action_high=high)
