"""The spaces of an environment, read in a short process of its own (``describer.py``).

A learner does not play: whatever an environment holds, changes or starts ends with the process.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from a2s.actors.children import Asked
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Spaces


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


class Describing:
    """Has an environment made once, reset and closed in another process; close it.

    It begins at once: this process can do something else. ``on_words`` gets what the environment
    prints and which calls are slow.
    """

    def __init__(self, config: EnvConfig, on_words: Callable[[str], None]) -> None:
        self._asked = Asked("a2s.actors.describer", config, on_words)
        self.close = self._asked.close

    def result(self, proceed: Callable[[], bool] = lambda: True) -> Description | None:
        """Wait for the description; ``None`` once ``proceed``, asked repeatedly, is false.

        Raises:
            UsageError: The environment does not exist, or its spaces are not supported.
            FaultyEnvironmentError: It raised, hung or died.
        """
        found = self._asked.answer(proceed)
        if not found:
            return None
        arrays: dict[str, Any] = {
            name: None if numbers is None else np.array(numbers, dtype=np.float32)
            for name, numbers in found["arrays"].items()
        }
        spaces = Spaces(obs_size=found["obs_size"], **arrays)
        layout = [(name, size) for name, size in found["layout"]]
        return Description(spaces, layout, found["episode_limit"])
