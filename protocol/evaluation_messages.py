"""The messages between a learner and an evaluator; see ``messages.py``."""

from dataclasses import dataclass
from typing import Literal, get_args

from a2s.protocol.checks import MAX_METRICS, NAME, is_name, require, require_counts
from a2s.protocol.messages import MAX_PLAYED, EpisodeMetric

EvaluationMode = Literal["mean", "best-of-k"]
MODES: tuple[EvaluationMode, ...] = get_args(EvaluationMode)
MAX_EPISODES = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationRequest:
    """An evaluator asks for weights to be evaluated."""

    evaluator: str  # as the name of an actor, and seen under the same token

    def __post_init__(self) -> None:
        """Check the name."""
        require(is_name(self.evaluator), "evaluation: evaluator", repr(self.evaluator), NAME)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationTask:
    """Weights to be evaluated; the graph's metadata say in which environment."""

    generation: int  # of the learner
    number: int  # counts the evaluations of that learner from 1
    env_steps: int  # of the run, when it had these weights
    weights_version: int
    modes: tuple[EvaluationMode, ...]  # how to act: the episodes are played in each way
    episodes: int
    seed: int  # of the episodes and of noise
    graph: bytes

    def __post_init__(self) -> None:
        """Check that the work is bounded."""
        found, ways = self.episodes, self.modes
        require(1 <= found <= MAX_EPISODES, "evaluation: episodes", found, f"1..{MAX_EPISODES}")
        once = len(ways) == len(set(ways)) > 0
        require(once, "evaluation: modes", ways, "at least one, none twice")
        require(0 <= self.seed < 1 << 63, "evaluation: seed", self.seed, "0 to 2^63 - 1")
        names = ("generation", "number", "env_steps", "weights_version")
        require_counts("evaluation", self, *names)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluatedEpisode:
    """One episode that was played to its end."""

    mode: EvaluationMode
    episode_return: float  # undiscounted
    length: int  # steps

    def __post_init__(self) -> None:
        """Check the numbers."""
        size = abs(self.episode_return)
        fits = size <= MAX_PLAYED  # false for NaN
        require(fits, "evaluation: return", self.episode_return, f"at most {MAX_PLAYED:g} in size")
        require(self.length >= 1, "evaluation: length", self.length, "at least 1")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationResult:
    """What came of a task; the answer is empty, and without one it is sent again."""

    evaluator: str
    generation: int  # of the task
    number: int
    episodes: tuple[EvaluatedEpisode, ...]
    metrics: tuple[EpisodeMetric, ...] = ()  # means over the episodes by the mean action

    def __post_init__(self) -> None:
        """Check the name, and that the work is bounded."""
        require(is_name(self.evaluator), "evaluation: evaluator", repr(self.evaluator), NAME)
        require_counts("evaluation", self, "generation", "number")
        count, most = len(self.episodes), MAX_EPISODES * len(MODES)
        require(1 <= count <= most, "evaluation: episodes", count, f"1..{most}")
        count = len(self.metrics)
        require(count <= MAX_METRICS, "evaluation: metrics", count, f"at most {MAX_METRICS}")
