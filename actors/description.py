"""The spaces of an environment, read in a short process of its own: ``python -m`` this module.

A learner does not play: whatever an environment holds, changes or starts ends with the process.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from a2s.actors.children import ask_child
from a2s.actors.environments.environment import Environment
from a2s.actors.environments.making import seed_globals
from a2s.actors.parent import Parent, answer
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Array, Spaces

_LARGE = 1000.0
_SEED = 0


class Description(NamedTuple):
    """The facts about an environment that a learner needs.

    Attributes:
        spaces: As flat Boxes.
        layout: ``[name, size]`` of the parts of an observation, in the order of its numbers.
        episode_limit: Steps after which Gymnasium truncates an episode; ``None``: never.
    """

    spaces: Spaces
    layout: list[tuple[str, int]]
    episode_limit: int | None


def describe(
    config: EnvConfig,
    on_words: Callable[[str], None],
    proceed: Callable[[], bool] = lambda: True,
) -> Description | None:
    """Make the environment once, reset it, and close it, in another process.

    ``on_words`` gets what it prints and which calls are slow. ``proceed`` is called repeatedly;
    when it returns false, the process is ended and there is no result.

    Raises:
        UsageError: The environment does not exist, or its spaces are not supported.
        FaultyEnvironmentError: It raised, hung or died.
    """
    found = ask_child(__name__, config, on_words, proceed)
    if not found:
        return None
    arrays: dict[str, Any] = {
        name: None if numbers is None else np.array(numbers, dtype=np.float32)
        for name, numbers in found["arrays"].items()
    }
    spaces = Spaces(obs_size=found["obs_size"], **arrays)
    layout = [(name, size) for name, size in found["layout"]]
    return Description(spaces, layout, found["episode_limit"])


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
