"""Reads a Minari data set as segments, one an episode."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim

from a2s.actors.environments.spaces import bounds_of
from a2s.commands.minari_export import require_minari
from a2s.learner.replay.files import Description
from a2s.protocol.checks import require
from a2s.protocol.errors import A2SError, MalformedMessageError, UsageError
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import Segment

_ACTOR = "minari"
_ROUNDING = 1e-6  # of the bounds' distance: float64 actions and float32 bounds


class MinariSegments:
    """The episodes of a data set, by its directory or, where Minari keeps it, by its name.

    Observations are flat, in the order of their space; what follows the last step of an episode is
    worth 0 only if that terminated.

    Attributes:
        about: The environment, by the id that the data set has for it, empty where it has none.
        num_steps: Of all episodes.

    Raises:
        UsageError: Minari is not installed, there is no such data set, or it has other spaces than
            Boxes.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._data = _load(source)
        self.num_steps = int(self._data.total_steps)
        spec = self._data.env_spec
        self.about = Description(
            env_id=spec.id if spec else "",
            spaces=self._spaces(),
            capacity=self.num_steps,
            files=0,
        )

    def __iter__(self) -> Iterator[Segment]:
        """Read them.

        Raises:
            MalformedMessageError: One has something that cannot be learned from; it is named.
            UsageError: The data set is damaged.
        """
        episodes = iter(self._data.iterate_episodes())
        number = 0
        while (episode := _read(self._source, lambda: next(episodes, None))) is not None:
            if len(episode.rewards):
                yield self._segment(number, episode)
            number += 1

    def _spaces(self) -> Spaces:
        space = self._data.action_space
        if not isinstance(space, spaces.Box):
            raise UsageError(
                f"{self._source}: found actions {space}, expected a Box; name another data set"
            )
        low, high = bounds_of(space)
        try:
            size = sum(flatdim(part) for part in _boxes(self._data.observation_space))
            return Spaces(obs_size=size, action_low=low, action_high=high)
        except MalformedMessageError as error:
            raise UsageError(f"{self._source}: {error}; name another data set") from None

    def _segment(self, number: int, episode: Any) -> Segment:
        subject, about = f"episode {number}", self.about.spaces
        steps = len(episode.rewards)
        ends = np.asarray(episode.terminations) | np.asarray(episode.truncations)
        action = _rows(f"{subject}: actions", episode.actions, steps, about.action_size)
        space = self._data.observation_space
        obs = _observations(f"{subject}: observations", space, episode.observations, steps + 1)
        require(not ends[:-1].any(), subject, "an end before its last step", "one at its end")
        terminated = bool(episode.terminations[-1])
        with np.errstate(over="ignore"):  # a segment refuses what is too large
            rewards = np.asarray(episode.rewards).astype(np.float32)
            flat = obs.astype(np.float32)
        try:
            return Segment(
                actor=_ACTOR,
                seq=number,
                generation=1,
                epoch=0,
                weights_version=0,
                env=0,
                obs=flat[:-1],
                suggestion=canonical(subject, action, about),
                log_prob=np.zeros(steps, np.float32),
                reward=rewards,
                final_obs=flat[-1],
                terminated=terminated,
                truncated=not terminated,
                episode_return=0.0,
                episode_length=steps,
            )
        except MalformedMessageError as error:
            raise MalformedMessageError(
                str(error).replace(f"segment {_ACTOR}/{number}", subject)
            ) from None


def is_data_set(path: Path) -> bool:
    """Tell whether a directory is that of a Minari data set."""
    return (path / "data" / "metadata.json").exists()


def canonical(subject: str, action: npt.NDArray[Any], about: Spaces) -> Array:
    """Turn actions as the environment took them into canonical ones: `executed`, undone.

    Raises:
        MalformedMessageError: One is out of its bounds, or is not finite.
    """
    low, high = about.action_low.astype(np.float64), about.action_high.astype(np.float64)
    wide = (2.0 * action - (high + low)) / (high - low)
    beyond = ~(np.abs(wide) <= 1.0 + 2.0 * _ROUNDING)  # true for NaN
    if beyond.any():
        step, which = np.argwhere(beyond)[0]
        require(
            False,
            f"{subject}: action {which} of step {step}",
            action[step, which],
            f"{low[which]:g} to {high[which]:g}",
        )
    return np.clip(wide, -1.0, 1.0).astype(np.float32)


def _boxes(space: "spaces.Space[Any]") -> Iterator[spaces.Box]:
    """Name the parts of an observation in their order."""
    if isinstance(space, spaces.Dict):
        for part in space.values():
            yield from _boxes(part)
    elif isinstance(space, spaces.Box):
        yield space
    else:
        require(False, "observations", space, "a Box, or a Dict of them")


def _observations(
    subject: str, space: "spaces.Space[Any]", value: Any, rows: int
) -> npt.NDArray[np.float64]:
    if isinstance(space, spaces.Dict):
        parts = [_observations(subject, part, value[key], rows) for key, part in space.items()]
        return np.concatenate(parts, axis=1)
    return _rows(subject, value, rows, flatdim(space))


def _rows(subject: str, value: Any, rows: int, size: int) -> npt.NDArray[np.float64]:
    found = np.asarray(value, np.float64)
    fits = len(found) == rows and found.size == rows * size
    require(fits, subject, f"shape {found.shape}", f"{rows} of {size} numbers")
    return found.reshape(rows, size)


def _load(source: str) -> Any:
    """Open a data set."""
    if not Path(source).is_dir():
        require_minari(f"{source}: is no directory, and a Minari data set")
    require_minari(source)
    import minari

    if is_data_set(Path(source)):
        return _read(source, lambda: minari.MinariDataset(Path(source) / "data"))
    try:
        return _read(source, lambda: minari.load_dataset(source))
    except FileNotFoundError:
        raise UsageError(
            f"{source}: found neither a directory nor a Minari data set of this name; "
            f"if it is one of Minari's, get it: minari download {source}"
        ) from None


def _read(source: str, read: Callable[[], Any]) -> Any:
    """Read from a data set; whatever Minari and h5py raise is one line."""
    try:
        return read()
    except (FileNotFoundError, A2SError):
        raise
    except (OSError, ValueError, KeyError, TypeError, AssertionError, gymnasium.error.Error) as e:
        reason = " ".join(str(e).split())
        raise UsageError(f"{source}: cannot be read as a Minari data set ({reason})") from None
