"""A trained policy as a Python object: observations in, actions out."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import numpy.typing as npt

from a2s.actors.evaluation import read_policy
from a2s.actors.suggester import Mode, Suggester
from a2s.protocol.errors import UsageError, nearest
from a2s.protocol.fields import Array


class Policy:
    """A trained policy. ``seed`` is for the noise, in the modes that use any.

    Attributes:
        env_id: The environment that it was trained on.
        obs_size: Numbers of an observation, D: flattened in the order of the space, the frames of
            a stack from the oldest to the newest.
        action_size: Numbers of an action, A.
        weights_version: Version of its weights.
    """

    def __init__(self, suggester: Suggester, seed: int) -> None:
        metadata = suggester.metadata
        self.env_id = metadata.get("env", "")
        self.obs_size = int(metadata["obs_size"])
        self.action_size = int(metadata["action_size"])
        self.weights_version = int(metadata["weights_version"])
        self._offset = np.array(json.loads(metadata.get("obs_offset", "0.0")))
        self._suggester, self._rng = suggester, np.random.default_rng(seed)

    def __call__(self, obs: npt.ArrayLike) -> Array:
        """Choose actions for one observation ``[D]`` of the environment, or several ``[B, D]``.

        Returns:
            In the environment's units and bounds, float32 ``[A]`` or ``[B, A]``.

        Raises:
            UsageError: The observations have another size.
        """
        if isinstance(obs, dict):
            raise UsageError(
                "obs: found a dict, expected an array; flatten it with "
                "gymnasium.spaces.flatten(env.observation_space, obs)"
            )
        given = np.asarray(obs, dtype=np.float64)
        if given.ndim not in (1, 2) or given.shape[-1] != self.obs_size:
            size = self.obs_size
            raise UsageError(f"obs: found shape {given.shape}, expected ({size},) or (B, {size})")
        batch = (np.atleast_2d(given) - self._offset).astype(np.float32)
        action = self._suggester(batch, self._rng).action
        return action.reshape(*given.shape[:-1], self.action_size)


def load_policy(path: Path, mode: str, seed: int) -> Policy:
    """Load the policy of a run directory, the best if there is one, or a policy file.

    Raises:
        UsageError: There is no policy, or the mode is unknown.
    """
    if path.is_dir():
        best, latest = (path / which / "policy.onnx" for which in ("best", "latest"))
        path = best if best.exists() else latest
    return Policy(read_policy(path, mode_of(mode)), seed)


def mode_of(name: str) -> Mode:
    """Read the name of a way to act.

    Raises:
        UsageError: The mode is unknown.
    """
    for mode in get_args(Mode):
        if mode == name:
            return mode  # type: ignore[no-any-return]
    raise UsageError(f"mode: found {name!r}{nearest(name, get_args(Mode))}")
