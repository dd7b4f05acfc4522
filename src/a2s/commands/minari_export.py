"""Writes a Minari data set; only this file and `minari_import` know Minari."""

import copy
import importlib
import importlib.util
import os
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from a2s import __version__
from a2s.learner.replay.episodes import Episode, StoredEpisodes
from a2s.learner.run import config as configuration
from a2s.learner.run.directory import CONFIG
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, UsageError, said_by
from a2s.protocol.fields import Array, Spaces

_VARIABLE = "MINARI_DATASETS_PATH"
_GROUP_BYTES = 16 * 1024
_OUTSIDE = ("wrappers", "action_repeat", "frame_stack")


def export(path: Path, dataset_id: str, root: Path | None) -> dict[str, Any]:
    """Write the whole episodes of a replay as a Minari data set.

    Actions are as the environment took them: in its units, clipped to its bounds. ``dataset_id`` is
    for example ``a2s/hopper-v0``; without ``root`` Minari chooses the folder of data sets.

    Returns:
        ``dataset``, ``path``, ``episodes``, ``steps``; ``left_out``, the number of episodes of
        which not all steps are in the replay, or that were left before their end; and
        ``no_env_spec``, why the data set does not say how to make its environment, ``None`` where
        it does.

    Raises:
        UsageError: Minari is not installed, the name is taken or malformed, ``root`` cannot hold
            a data set, or no episode is whole.
        RunDirectoryError: There is no replay, or it is damaged.
        A2SError: The data set cannot be written, for example for lack of room; it is removed.
    """
    require_minari("export")
    import minari

    namespace = _namespace_of(dataset_id)
    kept = os.environ.get(_VARIABLE) or Path.home() / ".minari" / "datasets"
    root = Path(root or kept).absolute()  # Minari takes a relative one for relative to itself
    stored = StoredEpisodes(path)
    spaces = stored.about.spaces
    spec, no_spec = spec_of(stored.about.env_id, _made_by_run(path))
    episodes = list(stored)
    if not episodes:
        raise UsageError(f"replay {path}: found no whole episode, {stored.left_out} in part")
    with _whole_or_not(dataset_id, namespace, root) as partial:
        _require_room(partial, sum(map(room_of, episodes)))
        with _kept_in(partial), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about an unknown author
            dataset = minari.create_dataset_from_buffers(
                dataset_id=dataset_id,
                buffer=[_buffer(i, episode, spaces) for i, episode in enumerate(episodes)],
                env=spec,
                observation_space=Box(-np.inf, np.inf, (spaces.obs_size,), np.float32),
                action_space=Box(spaces.action_low, spaces.action_high, dtype=np.float32),
                algorithm_name=f"a2s {__version__}",
                description=f"Transitions of {stored.about.env_id}, from a replay of a2s.",
                data_format="hdf5",
            )
        return {
            "dataset": dataset_id,
            "path": str(root / dataset_id),
            "episodes": int(dataset.total_episodes),
            "steps": int(dataset.total_steps),
            "left_out": stored.left_out,
            "no_env_spec": no_spec,
        }


def require_minari(subject: str) -> None:
    """Raise a UsageError where Minari is not installed."""
    if any(importlib.util.find_spec(module) is None for module in ("minari", "h5py")):
        raise UsageError(
            f"{subject} needs minari with hdf5; install them: pip install 'a2s[minari]'"
        )


def _buffer(index: int, episode: Episode, spaces: Spaces) -> Any:
    from minari.data_collector import EpisodeBuffer

    ends = np.arange(len(episode.reward)) == len(episode.reward) - 1
    return EpisodeBuffer(
        id=index,
        observations=episode.obs,
        actions=executed(episode.action, spaces),
        rewards=episode.reward.tolist(),
        terminations=(ends & episode.terminated).tolist(),
        truncations=(ends & (not episode.terminated)).tolist(),
    )


def executed(action: Array, spaces: Spaces) -> Array:
    """Compute the actions that the environment took, as the actors' graph does, to the bit.

    From canonical, not clipped, to the environment's units and bounds, float32 ``[T, A]`` both.
    """
    low, high, half = spaces.action_low, spaces.action_high, np.float32(0.5)
    wide: Array = action * ((high - low) * half) + (high + low) * half
    return np.clip(wide, low, high)


def _made_by_run(path: Path) -> EnvConfig | None:
    """How the run of a replay made its environment; ``None``: it is not that of a run."""
    config = path.parent / CONFIG
    if path.name != "replay" or not config.exists():
        return None
    return configuration.assemble(configuration.read(config)[0], {}).run.env_config()


def spec_of(env_id: str, made: EnvConfig | None = None) -> tuple[EnvSpec | None, str | None]:
    """Find how to make the environment as the run did; the data are useful without it too.

    Returns:
        The spec, and ``None``; or ``None``, and the reason why it cannot be written down.
    """
    spec, why = _registered(env_id)
    if spec is None:
        return None, why
    if made is not None:
        usual = EnvConfig(env_id=env_id)
        others = [each for each in _OUTSIDE if getattr(made, each) != getattr(usual, each)]
        if others:
            return None, f"the run made it with {', '.join(others)}, which a spec does not keep"
        spec.kwargs = {**spec.kwargs, **made.constructor_arguments(0, 0)}
        spec.max_episode_steps = made.max_episode_steps or spec.max_episode_steps
    made_by: Any = spec.entry_point
    module, name = (getattr(made_by, key, "") for key in ("__module__", "__qualname__"))
    if module != "__main__" and getattr(sys.modules.get(module), name, None) is made_by:
        spec.entry_point = f"{module}:{name}"  # a class, by a name under which it is found again
    try:
        spec.to_json()
    except (TypeError, ValueError):  # the latter for what can be called
        return None, "it was registered with objects that cannot be written down as text"
    return spec, None


def _registered(env_id: str) -> tuple[EnvSpec | None, str | None]:
    """A copy of what Gymnasium knows of it, and ``None``; or ``None``, and why it knows nothing."""
    module, _, name = env_id.rpartition(":")
    if module.endswith(".py"):
        return None, f"the run made it from a file, {Path(module).name}, which a spec does not keep"
    try:
        if module:
            importlib.import_module(module)
        return copy.copy(gymnasium.spec(name)), None
    except (gymnasium.error.Error, ImportError) as error:
        return None, " ".join(str(error).split())
    except Exception as error:  # noqa: BLE001  # whatever the module raises
        return None, said_by(error)


def _namespace_of(dataset_id: str) -> str | None:
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        namespace: str | None = parse_dataset_id(dataset_id)[0]
    except (ValueError, TypeError):  # the latter where there is no version
        raise UsageError(
            f"data set: found name {dataset_id!r}, expected one such as hopper-v0 or a2s/hopper-v0"
        ) from None
    return namespace


def room_of(episode: Episode) -> int:
    """Bytes in an HDF5 file, rather too many: groups of 14 KiB, and chunks that are filled up."""
    flags_and_reward = len(episode.reward) * (8 + 1 + 1)
    return _GROUP_BYTES + (episode.obs.nbytes + episode.action.nbytes + flags_and_reward) * 9 // 8


def _require_room(path: Path, num_bytes: int) -> None:
    """Take the room, and give it back: HDF5 crashes when the disk is full."""
    room = path / "room"
    try:
        with room.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, num_bytes)
    except OSError as error:
        needed = f"{num_bytes / 2**20:.1f} MiB are needed"
        raise A2SError(f"{path.parent}: {error.strerror}, {needed}; make room") from None
    room.unlink()


@contextmanager
def _whole_or_not(dataset_id: str, namespace: str | None, root: Path) -> Iterator[Path]:
    """Let a data set be made in a directory that Minari does not see, then put it into its place.

    Raises:
        UsageError: There is one of this name, or nothing can be written there.
        A2SError: It could not be made, and nothing of it is left.
    """
    from minari.namespace import create_namespace, list_local_namespaces

    final = root / dataset_id
    partial = root / f".{dataset_id.replace('/', '-')}.partial"
    try:
        if final.exists():
            raise UsageError(f"data set {final}: already exists; name another")
        shutil.rmtree(partial, ignore_errors=True)  # an export was killed here
        partial.mkdir(parents=True)
    except OSError as error:
        raise UsageError(
            f"data set {final}: {error.strerror}; name another directory with --root"
        ) from None
    try:
        yield partial
        with _kept_in(root):
            if namespace is not None and namespace not in list_local_namespaces():
                create_namespace(namespace)
        (partial / dataset_id).rename(final)
    except (OSError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise A2SError(f"data set {final}: {reason}; nothing of it is left") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _kept_in(root: Path) -> Iterator[None]:
    """Let Minari keep its data sets in a directory; it asks the environment where."""
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = str(root)
    try:
        yield
    finally:
        os.environ.pop(_VARIABLE)
        if before is not None:
            os.environ[_VARIABLE] = before
