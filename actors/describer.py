"""Describes an environment: a child process, ``python -m`` this module; see ``description.py``."""

import numpy as np
import numpy.typing as npt

from a2s.actors.environments.environment import Environment
from a2s.actors.environments.making import seed_globals
from a2s.actors.parent import Parent, answer
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Array

_LARGE = 1000.0
_SEED = 0


def offset_of(obs: npt.NDArray[np.float64]) -> Array | None:
    """Choose the offset of observations: the large numbers of the first one, in float32.

    float32 has seven digits: in a number of a million a change of a hundredth would be lost.
    """
    with np.errstate(over="ignore"):
        large = np.where(np.abs(obs) >= _LARGE, obs, 0.0).astype(np.float32)
    usable: Array = np.where(np.isfinite(large), large, np.float32(0.0))
    return usable if usable.any() else None


def _describe(parent: Parent) -> None:
    seed_globals(_SEED)
    environment = Environment(EnvConfig.from_json(parent.task["env"]), activity=parent.activity)
    offset = offset_of(environment.first_obs(_SEED))
    spaces = environment.spaces
    arrays = {
        "action_low": spaces.action_low.tolist(),
        "action_high": spaces.action_high.tolist(),
        "obs_offset": None if offset is None else offset.tolist(),
    }
    result = {"obs_size": spaces.obs_size, "arrays": arrays, "layout": environment.layout}
    parent.report({"result": {**result, "episode_limit": environment.episode_limit}})
    environment.close()


if __name__ == "__main__":
    answer(_describe)
