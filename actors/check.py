"""A trial of an environment in its own process: its spaces, its behaviour, its speed."""

import contextlib
import functools
import re
import warnings
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env

from a2s.actors.activity import CLOSE, MAKE, RESET, STEP, Activity
from a2s.actors.children import Report, ask_child
from a2s.actors.environments.environment import Environment
from a2s.actors.environments.making import make, seed_globals
from a2s.actors.parent import Parent, answer
from a2s.actors.rollout import (
    MAX_USELESS_IN_A_ROW,
    is_usable,
    useless,
    wrong_in,
    wrong_reward,
)
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import said_by

_STEPS = 2000
_SECONDS = 5.0
_MAX_REMARKS = 10
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def check(config: EnvConfig, on_words: Callable[[str], None]) -> Report:
    """Try an environment; give the JSON object of ``a2s check --json``.

    Raises:
        UsageError: The environment does not exist, or its spaces are not supported.
        FaultyEnvironmentError: It raised, hung, died, or returned something invalid.
    """
    return ask_child(__name__, config, on_words)


class _Attempts:
    """Episodes that training would begin: ten in a row without a step that can be used end it."""

    def __init__(self, environment: str) -> None:
        self._environment = environment
        self.succeeded()

    def succeeded(self) -> None:
        """A step can be used."""
        self._since, self._empty = "", 0

    def failed(self, wrong: str, where: str, *, is_empty: bool) -> None:
        """A step cannot, and the episode is cut before it; ``is_empty``: nothing is left of it.

        Raises:
            FaultyEnvironmentError: That is too often.
        """
        self._since = self._since or where
        self._empty += is_empty
        if self._empty >= MAX_USELESS_IN_A_ROW:
            raise useless(self._environment, f"{wrong}, from {self._since} on")


def _play(environment: Environment, rng: np.random.Generator) -> Report:
    """Step with random actions, and count."""
    spaces = environment.spaces
    low, high = spaces.action_low.astype(np.float64), spaces.action_high.astype(np.float64)
    first_unusable = ""
    rewards: list[float] = []
    lengths: list[int] = []
    ends, unusable = [0, 0], 0
    attempt = _Attempts(environment.name)
    obs, length, begin_s = environment.reset(), 0, perf_counter()
    while not rewards or (len(rewards) < _STEPS and perf_counter() - begin_s < _SECONDS):
        if not is_usable(obs):
            attempt.failed(wrong_in(obs), f"the reset after step {len(rewards)}", is_empty=True)
            obs = environment.reset()
            continue
        action = np.clip(rng.uniform(low, high), low, high).astype(np.float32)
        obs, reward, terminated, truncated = environment.step(action)
        rewards.append(reward)
        wrong = wrong_reward(reward) or ("" if is_usable(obs) else wrong_in(obs))
        if wrong:
            unusable += 1
            first_unusable = first_unusable or f"the {wrong.split()[0]} of step {len(rewards)}"
        # What follows a terminal step is not used.
        if wrong_reward(reward) or (wrong and not terminated):
            attempt.failed(wrong, f"step {len(rewards)}", is_empty=length == 0)
            obs, length = environment.reset(), 0
            continue
        attempt.succeeded()
        length += 1
        if terminated or truncated:
            ends[truncated] += 1
            lengths.append(length)
            obs, length = environment.reset(), 0
    return {
        "steps": len(rewards),
        "steps_per_s": round(len(rewards) / (perf_counter() - begin_s), 1),
        "episode_lengths": lengths,
        "terminated": ends[0],
        "truncated": ends[1],
        "rewards": [float(np.nanmin(rewards)), float(np.nanmax(rewards))],
        "unusable_steps": unusable,
        "first_unusable": first_unusable,
        "info_metrics": sorted(m.name for m in environment.metrics()),
        "other_numbers": environment.other_numbers(),
    }


def _repeats(environment: Environment, action: Any) -> bool:
    """Whether the same seed makes the same first steps."""

    def begin() -> list[Any]:
        seed_globals(1)
        seen: list[Any] = [environment.reset(1)]
        for _ in range(5):
            obs, reward, terminated, truncated = environment.step(action)
            seen += [obs, reward]
            if terminated or truncated:
                break
        return seen

    first, second = begin(), begin()
    return len(first) == len(second) and all(
        np.array_equal(a, b, equal_nan=True) for a, b in zip(first, second, strict=True)
    )


def _noted(activity: Activity, call: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """Note a call into an environment on the page, so that each call has its own time."""

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        activity.begin(call, 0)
        try:
            return function(*args, **kwargs)
        finally:
            activity.end()

    return called


def _remarks(config: EnvConfig, activity: Activity) -> list[str]:
    """Return the remarks of Gymnasium's own checker."""
    found = list[str]()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            env, _ = _noted(activity, MAKE, make)(config, 0, 0)
        except BaseException as error:  # noqa: BLE001  # whatever a user's code raises
            return [f"a second one cannot be made: {said_by(error)}"]
        try:
            for name, call in (("reset", RESET), ("step", STEP), ("close", CLOSE)):
                method = _noted(activity, call, getattr(env.unwrapped, name))
                setattr(env.unwrapped, name, method)
            check_env(env.unwrapped, skip_render_check=True)
        except BaseException as error:  # noqa: BLE001  # it asserts and raises all
            found = [said_by(error)]
        with contextlib.suppress(BaseException):  # the first one's has been said
            env.close()
    theirs = [w for w in said if not issubclass(w.category, ResourceWarning)]
    lines = [_COLOURS.sub("", line) for line in (*found, *(str(w.message) for w in theirs))]
    return list(dict.fromkeys(" ".join(x.split()).removeprefix("WARN: ") for x in lines))


def _check(parent: Parent) -> None:
    config = EnvConfig.from_json(parent.task["env"])
    environment = Environment(config, activity=parent.activity)
    spaces = environment.spaces
    middle = ((spaces.action_low + spaces.action_high) / 2).astype(np.float32)
    found = {
        "env": config.env_id,
        "obs_size": spaces.obs_size,
        "obs_layout": environment.layout,
        "frame_stack": config.frame_stack,
        "action_repeat": config.action_repeat,
        "action_low": spaces.action_low.tolist(),
        "action_high": spaces.action_high.tolist(),
        "max_episode_steps": environment.episode_limit,
        "repeats": _repeats(environment, middle),
        **_play(environment, np.random.default_rng(0)),
    }
    environment.close()
    remarks = _remarks(config, parent.activity)[:_MAX_REMARKS]
    parent.report({"result": {**found, "remarks": remarks}})


if __name__ == "__main__":
    answer(_check)
