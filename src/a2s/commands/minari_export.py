"""Writing a Minari data set: the one place that knows Minari."""

import importlib
import importlib.util
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from a2s import __version__
from a2s.learner.replay.episodes import StoredEpisodes
from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Array, Spaces

_VARIABLE = "MINARI_DATASETS_PATH"


def export(path: Path, dataset_id: str, root: Path | None) -> dict[str, Any]:
    """Write the whole episodes of a replay as a Minari data set.

    Actions are as the environment took them: in its units, clipped to its bounds.

    Args:
        path: A replay directory.
        dataset_id: For example ``a2s/hopper-v0``.
        root: Where data sets are kept; ``None``: where Minari looks for them.

    Returns:
        What was written: ``dataset``, ``path``, ``episodes``, ``steps`` and ``left_out``, the
        number of episodes of which not all steps are in the replay.

    Raises:
        UsageError: Minari is not installed, the name is taken or none, or no episode is whole.
        RunDirectoryError: There is no replay, or it is damaged.
    """
    if any(importlib.util.find_spec(module) is None for module in ("minari", "h5py")):
        raise UsageError("export needs minari with hdf5; install them: pip install 'a2s[minari]'")
    import minari
    from minari.data_collector import EpisodeBuffer

    episodes = StoredEpisodes(path)
    spaces = episodes.about.spaces
    low, high = spaces.action_low, spaces.action_high
    buffers = []
    for index, episode in enumerate(episodes):
        steps = len(episode.reward)
        ends = np.arange(steps) == steps - 1
        buffers.append(
            EpisodeBuffer(
                id=index,
                observations=episode.obs,
                actions=executed(episode.action, spaces),
                rewards=episode.reward.tolist(),
                terminations=(ends & episode.terminated).tolist(),
                truncations=(ends & (not episode.terminated)).tolist(),
            )
        )
    if not buffers:
        raise UsageError(f"replay {path}: found no whole episode, {episodes.left_out} in part")
    with _kept_in(root), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about an author that we do not know
        try:
            dataset = minari.create_dataset_from_buffers(
                dataset_id=dataset_id,
                buffer=buffers,
                env=_spec(episodes.about.env_id),
                observation_space=gymnasium.spaces.Box(
                    -np.inf, np.inf, (spaces.obs_size,), np.float32
                ),
                action_space=gymnasium.spaces.Box(low, high, dtype=np.float32),
                algorithm_name=f"a2s {__version__}",
                description=f"Transitions of {episodes.about.env_id}, from a replay of a2s.",
                data_format="hdf5",
            )
        except ValueError as error:
            raise UsageError(f"data set {dataset_id}: {error}") from None
        return {
            "dataset": dataset_id,
            "path": str(dataset.storage.data_path.parent),
            "episodes": int(dataset.total_episodes),
            "steps": int(dataset.total_steps),
            "left_out": episodes.left_out,
        }


def executed(action: Array, spaces: Spaces) -> Array:
    """Compute what the environment took, as the graph that actors run does, to the bit.

    Args:
        action: Canonical, not clipped, float32 ``[T, A]``.
        spaces: Of the environment.

    Returns:
        In its units and within its bounds, float32 ``[T, A]``.
    """
    low, high, half = spaces.action_low, spaces.action_high, np.float32(0.5)
    wide: Array = action * ((high - low) * half) + (high + low) * half
    return np.clip(wide, low, high)


def _spec(env_id: str) -> "gymnasium.envs.registration.EnvSpec | None":
    """Find how to make the environment; the data are of use without it too."""
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        spec = gymnasium.spec(name)
        spec.to_json()  # one that was registered with a class cannot be written down
    except (gymnasium.error.Error, ImportError, ValueError):
        return None
    return spec


@contextmanager
def _kept_in(root: Path | None) -> Iterator[None]:
    """Let Minari keep its data sets in a directory; it asks the environment where."""
    before = os.environ.get(_VARIABLE)
    if root is not None:
        os.environ[_VARIABLE] = str(root)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_VARIABLE, None)
        else:
            os.environ[_VARIABLE] = before
