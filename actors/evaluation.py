"""Fresh episodes with a fixed policy, in a process of their own."""

import json
import logging
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2s.actors.activity import Activity
from a2s.actors.children import ask_child
from a2s.actors.environments.environment import Environment, require_alike
from a2s.actors.environments.making import MAX_SEED, seed_globals
from a2s.actors.parent import Parent, answer
from a2s.actors.rollout import (
    MAX_USELESS_IN_A_ROW,
    is_usable,
    useless,
    wrong_in,
    wrong_reward,
)
from a2s.actors.suggester import Choice, Mode, Suggester
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import MalformedMessageError, UsageError
from a2s.protocol.fields import Array
from a2s.protocol.messages import ENDLESS_STEPS

logger = logging.getLogger(__name__)

# Keeps the seeds of evaluation apart from those of training.
_EVALUATION = 0xE7A1


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The result of evaluating a policy.

    Attributes:
        returns: Undiscounted return of each episode.
        lengths: Steps of each episode.
        metrics: Mean over the episodes of the environment's metrics at their ends, by name.
        unusable_steps: Steps with numbers that are not finite or too large.
    """

    returns: list[float]
    lengths: list[int]
    metrics: dict[str, float]
    unusable_steps: int = 0

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over the episodes."""
        return float(np.std(self.returns))


def read_policy(path: Path, mode: Mode) -> Suggester:
    """Load a policy file.

    Raises:
        UsageError: The file does not exist, or is not a policy.
    """
    try:
        return Suggester(path.read_bytes(), mode)
    except OSError as error:
        raise UsageError(f"policy {path}: {error.strerror}") from None
    except MalformedMessageError as error:
        raise UsageError(f"policy {path}: {error}") from None


def evaluate(
    path: Path,
    mode: Mode,
    config: EnvConfig,
    *,
    episodes: int,
    num_envs: int,
    seed: int,
    on_words: Callable[[str], None],
    proceed: Callable[[], bool] = lambda: True,
) -> Evaluation | None:
    """Play episodes in another process, in at most ``num_envs`` environments side by side.

    The same ``seed`` gives the same episodes; they are never those of training. ``on_words`` gets
    what the environment prints and which calls are slow. ``proceed`` is called repeatedly; when it
    returns false, the process is ended and there is no result.

    Raises:
        UsageError: The environment cannot be made, or does not fit the policy.
        FaultyEnvironmentError: The environment raised, hung or died.
    """
    found = ask_child(
        __name__, config, on_words, proceed,
        policy=str(path), mode=mode, episodes=episodes, num_envs=num_envs, seed=seed,
    )  # fmt: skip
    return Evaluation(**found) if found else None


def trained_on(name: str, metadata: Mapping[str, str]) -> EnvConfig | None:
    """The environment that a policy was trained on, by its metadata; ``None``: not told.

    Raises:
        UsageError: They cannot be read; ``name`` is the policy's.
    """
    if "environment" not in metadata:
        return EnvConfig(env_id=metadata["env"]) if metadata.get("env") else None
    try:
        return replace(EnvConfig.from_json(metadata["environment"]), env_id=metadata["env"])
    except (ValueError, TypeError, KeyError, MalformedMessageError) as error:
        raise UsageError(f"{name}: its metadata 'environment' cannot be read: {error}") from None


def make_environments(
    config: EnvConfig, metadata: Mapping[str, str], count: int, activity: Activity
) -> list[Environment]:
    """Make so many environments for a policy with these metadata.

    Raises:
        UsageError: They cannot be made.
        FaultyEnvironmentError: The constructor raised, or they differ.
    """
    told = metadata.get("obs_offset")
    offset = None if told is None else np.array(json.loads(told), dtype=np.float32)
    environments = [
        Environment(config, index=index, activity=activity, offset=offset) for index in range(count)
    ]
    require_alike(environments)
    return environments


def play(
    policy: Suggester,
    environments: list[Environment],
    episodes: int,
    seed: int,
    proceed: Callable[[], bool] = lambda: True,
) -> Evaluation | None:
    """Play episodes, each from a seed of its own; ``None`` if ``proceed`` became false.

    Raises:
        UsageError: The environments do not fit the policy.
        FaultyEnvironmentError: One of them raised.
    """
    played = Episodes(policy, environments, episodes, seed)
    if not all(proceed() for _ in played.rounds()):
        return None
    return played.evaluation()


class Played(NamedTuple):
    """An episode so far: its number from 0, the sum of its rewards, its steps."""

    episode: int
    episode_return: float
    length: int


class Episodes:
    """Episodes with a policy in a few environments, each from a seed of its own.

    Raises:
        UsageError: The environments do not fit the policy.
        FaultyEnvironmentError: One of them raised.
    """

    def __init__(
        self, policy: Suggester, environments: list[Environment], episodes: int, seed: int
    ) -> None:
        drawn = np.random.SeedSequence([_EVALUATION, seed]).generate_state(episodes + 1)
        *env_seeds, noise_seed = (int(number) for number in drawn & MAX_SEED)
        self._policy, self._rng = policy, np.random.default_rng(noise_seed)
        policy.check(environments[0].spaces, environments[0].name)
        seed_globals(noise_seed)
        self._environments, self._seeds = environments, env_seeds
        self._returns, self._lengths = [0.0] * episodes, [0] * episodes
        self._metrics: dict[str, list[float]] = defaultdict(list)
        self._cut = self._unusable = 0
        self._useless = [0] * len(environments)  # unusable in a row, steps or first observations
        self._wrong = ""  # what was found there at first
        self._episode = [0] * len(environments)
        self._waiting = list(range(episodes))
        self._obs: dict[int, Array] = {}  # the latest of each environment that still plays
        for index in range(len(environments)):
            self._begin(index)

    def rounds(self) -> Iterator[Choice]:
        """Make a step in each environment that still plays, again and again; give the choices."""
        while playing := sorted(self._obs):
            obs = np.stack([self._obs[index] for index in playing])
            choice = self._policy(obs, self._rng)
            for index, action in zip(playing, choice.action, strict=True):
                self._step(index, action)
            yield choice

    def now(self, index: int) -> Played:
        """What an environment plays, or has played last."""
        episode = self._episode[index]
        return Played(episode, self._returns[episode], self._lengths[episode])

    def _step(self, index: int, action: Array) -> None:
        """Make a step in an environment; where its episode ends, begin the next."""
        environment, episode = self._environments[index], self._episode[index]
        obs, reward, terminated, truncated = environment.step(action)
        wrong = wrong_reward(reward)
        if not (terminated or truncated or is_usable(obs)):  # after the end nobody looks at it
            wrong = wrong or wrong_in(obs)
            obs = self._obs[index]
        if wrong:
            # As a robot would whose sensor fails for a moment: go on with what was seen last.
            self._unusable += 1
            self._note(index, wrong)
            reward = 0.0 if wrong_reward(reward) else reward
        else:
            self._useless[index] = 0
        self._returns[episode] += reward
        self._lengths[episode] += 1
        is_endless = environment.episode_limit is None and self._lengths[episode] >= ENDLESS_STEPS
        if not (terminated or truncated or is_endless):
            self._obs[index] = obs
            return
        self._cut += not (terminated or truncated)
        for metric in environment.metrics():
            self._metrics[metric.name].append(metric.value)
        self._begin(index)

    def _begin(self, index: int) -> None:
        if not self._waiting:
            self._obs.pop(index, None)
            return
        self._episode[index] = self._waiting.pop(0)
        obs = self._environments[index].reset(self._seeds[self._episode[index]])
        while not is_usable(obs):
            self._note(index, wrong_in(obs))
            obs = self._environments[index].reset(None)
        self._obs[index] = obs

    def _note(self, index: int, wrong: str) -> None:
        """Remember what could not be used; an environment that gives nothing else is broken."""
        self._wrong = self._wrong or wrong
        self._useless[index] += 1
        if self._useless[index] >= MAX_USELESS_IN_A_ROW:
            raise useless(self._environments[index].name, wrong)

    def evaluation(self) -> Evaluation:
        """Sum up the episodes, and report unusual ones."""
        name = self._environments[0].name
        if self._cut:
            logger.warning(
                "environment %s: %d of %d episodes had not ended after %s steps and were cut; "
                "--max-episode-steps sets the limit",
                name, self._cut, len(self._seeds), f"{ENDLESS_STEPS:,}",
            )  # fmt: skip
        if self._unusable:
            logger.warning(
                "environment %s: %d steps had numbers that are not finite or too large (%s); the "
                "observation before, or a reward of 0, was used, so returns are not what they seem",
                name, self._unusable, self._wrong,
            )  # fmt: skip
        means = {name: float(np.mean(values)) for name, values in self._metrics.items()}
        return Evaluation(
            returns=self._returns,
            lengths=self._lengths,
            metrics=means,
            unusable_steps=self._unusable,
        )


def _evaluate(parent: Parent) -> None:
    task: dict[str, Any] = parent.task
    policy = read_policy(Path(task["policy"]), task["mode"])
    config, count = EnvConfig.from_json(task["env"]), min(task["num_envs"], task["episodes"])
    seed_globals(task["seed"])
    environments = make_environments(config, policy.metadata, count, parent.activity)
    found = play(policy, environments, task["episodes"], task["seed"])
    assert found is not None
    parent.report({"result": asdict(found)})
    for environment in environments:
        environment.close()


if __name__ == "__main__":
    answer(_evaluate)
