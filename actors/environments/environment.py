"""One environment with a float32 interface, whatever the user's own one uses."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from a2s.actors.activity import CLOSE, MAKE, RENDER, RESET, STEP, Activity
from a2s.actors.environments.fast_mujoco import fast_steps
from a2s.actors.environments.faults import Faults, brief, wrong_reset
from a2s.actors.environments.making import as_usage, limit_of, make
from a2s.actors.environments.observations import Observations
from a2s.actors.environments.spaces import Layout, read_layout, read_spaces
from a2s.protocol.checks import MAX_METRICS
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError, said_by
from a2s.protocol.fields import Array
from a2s.protocol.messages import EpisodeMetric

logger = logging.getLogger(__name__)


class Environment:
    """One environment, from construction to close.

    Observations and actions are copied, because it may reuse one buffer. Its values may come in
    any shape, dtype or kind of sequence that has the right count of numbers. ``activity`` notes
    every call into it; ``offset``, float32 ``[D]``, is subtracted from observations. ``fast``:
    where it is one of Gymnasium's own, step it without making its ``info`` (docs/adr/0035).

    Attributes:
        name: Its id, for the user.
        spaces: As flat Boxes.
        layout: Parts of an observation and their sizes, in the order of its numbers.
        episode_limit: Steps after which Gymnasium truncates an episode; ``None``: never.

    Raises:
        UsageError: The environment does not exist, or its spaces are not supported.
        FaultyEnvironmentError: Its constructor raised.
    """

    def __init__(
        self,
        config: EnvConfig,
        *,
        worker: int = 0,
        index: int = 0,
        activity: Activity | None = None,
        offset: Array | None = None,
        fast: bool = False,
    ) -> None:
        self.name = config.env_id
        self._faults = Faults(config.env_id)
        activity = activity or Activity()
        self._begin, self._end = activity.begin, activity.end  # looked up once: a step calls these
        self._index = index
        self._metric_names = config.metric_names
        self._info: Mapping[str, Any] = {}
        self._begin(MAKE, index)
        try:
            self._env, takes_seed = make(config, worker, index)
            space: Any = self._env.observation_space
            self.layout: Layout = read_layout(config.env_id, space, config.frame_stack)
            self.spaces = read_spaces(config.env_id, self._env, config.frame_stack)
        except BaseException as error:  # whatever a user's code raises
            raise as_usage(config, error) or self._faults.of_make(error) from error
        self._end()
        self.episode_limit = limit_of(self._env)
        space = self._env.action_space
        self._action_dtype, self._action_shape = space.dtype, space.shape
        self._rounds = not np.issubdtype(space.dtype, np.floating)
        self._is_plain = not self._rounds and len(space.shape) == 1
        self._repeats = config.action_repeat
        size = self.spaces.obs_size // config.frame_stack
        self._observations = Observations(self._faults, self._env, size, config.frame_stack, offset)
        self._obs = self._observations.read
        self._fast = fast_steps(self._env) if fast and not config.info_metrics else None
        self._step_once = self._env.step if self._fast is None else self._fast.step
        self._step = self._step_once if self._repeats == 1 else self._repeated
        if not takes_seed and index == 0:
            logger.warning(
                "environment %s: its reset takes no seed; random and np.random are seeded instead",
                config.env_id,
            )

    def reset(self, seed: int | None = None) -> Array:
        """Begin an episode; give its first observation, float32 ``[D]``.

        A seed begins a reproducible series of episodes; ``None`` goes on with the present one.

        Raises:
            FaultyEnvironmentError: It raised, or returned something invalid.
        """
        return self._obs("reset", self._reset(seed))

    def first_obs(self, seed: int) -> npt.NDArray[np.float64]:
        """Begin an episode like :meth:`reset`; give its observation as float64, ``[D]``."""
        obs = self._reset(seed)
        self._obs("reset", obs)
        return self._observations.exact(obs)

    def _reset(self, seed: int | None) -> Any:
        self._begin(RESET, self._index)
        try:
            result = self._env.reset(seed=seed)
        except BaseException as error:  # whatever a user's code raises
            raise self._faults.of_call(
                "reset", self._env, error, lambda env: env.reset(seed=seed)
            ) from error
        if self._fast is not None:
            self._fast.begin()
        self._end()
        wrong = wrong_reset(result)
        if wrong:
            raise self._faults.returned(self._env, "reset", wrong.removeprefix("reset returned "))
        return result[0]

    def step(self, action: Array) -> tuple[Array, float, bool, bool]:
        """Make one step with an action in the environment's units, float32 ``[A]``.

        Returns:
            Next observation (float32 ``[D]``, the true final one at an end), reward,
            ``terminated`` and ``truncated``; never both, a terminal state wins.

        Raises:
            FaultyEnvironmentError: It raised, or returned something invalid.
        """
        own = action.astype(self._action_dtype) if self._is_plain else self._converted(action)
        self._begin(STEP, self._index)
        try:
            obs, reward, terminated, truncated, self._info = self._step(own)
        except FaultyEnvironmentError:
            raise
        except BaseException as error:  # whatever a user's code raises
            raise self._faults.of_call(
                "step", self._env, error, lambda env: env.step(own)
            ) from error
        self._end()
        if type(reward) is not float:  # NumPy's own float64 is one by isinstance
            reward = float(reward) if isinstance(reward, float) else self._number(reward)
        if type(terminated) is not bool:
            terminated = self._truth("terminated", terminated)
        if type(truncated) is not bool:
            truncated = self._truth("truncated", truncated)
        return self._obs("step", obs), reward, terminated, truncated and not terminated

    def picture(self) -> npt.NDArray[np.uint8]:
        """Draw the present state, ``[H, W, 3]``; it must have been made with ``rgb_array``.

        Raises:
            FaultyEnvironmentError: It raised, or gave something else.
        """
        self._begin(RENDER, self._index)
        try:
            found = np.asarray(self._env.render())
        except BaseException as error:  # whatever a user's code raises
            raise self._faults.raised("render", error) from error
        self._end()
        if found.ndim != 3 or found.shape[2] != 3 or found.dtype != np.uint8:
            what = f"of shape {found.shape} and {found.dtype}"
            raise self._faults.returned(
                self._env, "render", f"a picture {what}, expected (H, W, 3) and uint8"
            )
        return found

    @property
    def unwrapped(self) -> Any:
        """What is inside all wrappers."""
        return self._env.unwrapped

    def metrics(self) -> tuple[EpisodeMetric, ...]:
        """Give the finite numbers of the latest ``info`` under the keys that are wanted."""
        if not isinstance(self._info, Mapping):
            return ()
        found = []
        for name in self._metric_names[:MAX_METRICS]:
            try:
                number = float(np.asarray(self._info.get(name, np.nan)).reshape(()))
            except Exception:  # noqa: BLE001  # no number, or a user's object raises
                continue
            if np.isfinite(number):
                found.append(EpisodeMetric(name=name, value=number))
        return tuple(found)

    def other_numbers(self) -> list[str]:
        """Name the numbers of the latest ``info`` that were not requested."""
        info = self._info if isinstance(self._info, Mapping) else {}
        numbers = [k for k, v in info.items() if isinstance(v, int | float | np.number | np.bool_)]
        return sorted(str(k) for k in numbers if k not in self._metric_names)

    def close(self) -> None:
        """Free the simulator; an error is logged and otherwise ignored."""
        self._begin(CLOSE, self._index)
        try:
            self._env.close()
        except BaseException as error:  # noqa: BLE001  # whatever a user's code raises
            logger.warning("%s", self._faults.raised("close", error))
        self._end()

    def _converted(self, action: Array) -> Any:
        if self._rounds:
            action = np.rint(action)
        return action.astype(self._action_dtype).reshape(self._action_shape)

    def _repeated(self, own: Any) -> tuple[Any, float, bool, bool, Any]:
        """Make steps with one action, until the episode ends; the rewards are added up."""
        total = 0.0
        for _ in range(self._repeats):
            obs, reward, terminated, truncated, info = self._step_once(own.copy())
            total += self._number(reward)
            ends = self._truth("terminated", terminated), self._truth("truncated", truncated)
            if any(ends):
                break
        return obs, total, *ends, info

    def _number(self, reward: Any) -> float:
        try:
            found = np.asarray(reward, dtype=np.float64)
            why = ""
        except Exception as error:  # noqa: BLE001  # a user's object may raise anything
            found, why = np.empty(0), f" ({said_by(error)})"
        if found.size != 1 or reward is None:
            what = f"of shape {found.shape}" if found.size > 1 else f"of {brief(reward)}{why}"
            raise self._faults.returned(self._env, "step", f"a reward {what}, expected a number")
        return float(found.reshape(()))

    def _truth(self, name: str, value: Any) -> bool:
        if isinstance(value, np.bool_):
            return bool(value)
        try:
            found = np.asarray(value)
        except Exception:  # noqa: BLE001  # a user's object may raise anything
            found = np.empty(0)
        if found.size != 1 or found.dtype.kind not in "biuf" or isinstance(value, float):
            raise self._faults.returned(
                self._env, "step", f"{name} {brief(value)}, expected True or False; the order is "
                "obs, reward, terminated, truncated, info"
            )  # fmt: skip
        return bool(found.reshape(()))


def require_alike(environments: Sequence[Environment]) -> None:
    """Check that the environments of one process have the same spaces.

    Raises:
        FaultyEnvironmentError: One differs from the first.
    """
    first = environments[0]
    for index, environment in enumerate(environments):
        difference = first.spaces.differs_from(environment.spaces)
        if difference:
            raise FaultyEnvironmentError(
                f"environment {first.name}: environment {index} of this process has {difference} "
                "as the first",
                by_mistake=True,
            )
