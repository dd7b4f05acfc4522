"""The messages that cross the network.

A message is an immutable record of arrays and scalars: it knows its own consistency rules and
nothing of transport, tensors or files. ``docs/protocol.md`` gives the same list byte for byte.
The letters in the shapes are used throughout a2s::

    T  time steps in one segment      D  observation size
    K  suggestions per observation    A  action size
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import METRIC_NAME, NAME, Array, Spaces, is_metric_name, is_name, require
from a2s.protocol.fields import MOST_METRICS as MOST_METRICS

Clock = Literal["lockstep", "async"]
Verdict = Literal["accepted", "duplicate", "stale", "refused", "unknown"]

# Finite numbers whose sums and squares are not finite end the learning as well.
MOST_PLAYED = 1e10  # as in MuJoCo, which resets a simulation beyond it
MOST_SUGGESTED = 1e6
_MOST_SLOTS = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hello:
    """An actor asks for work, and after it has made the environment, joins.

    Attributes:
        actor: Unique name of this actor process (a restarted process has a new one).
        num_envs: Environments that it steps; 0 while it only asks.
        env_id: Environment that it has made; empty while it only asks.
        spaces: Their spaces; ``None`` while it only asks.
        cause: Why the process that had its place before had to be replaced; empty if none had, and
            when it joins again.
        slot: The place that it would like, so that runs repeat whoever joins first; -1: any.
    """

    actor: str
    num_envs: int
    env_id: str
    spaces: Spaces | None
    cause: str = ""
    slot: int = -1

    def __post_init__(self) -> None:
        """Check the name and that a joining actor says everything."""
        require(is_name(self.actor), "hello: actor", repr(self.actor), NAME)
        joins = self.spaces is not None
        require(
            joins == bool(self.env_id), "hello: env_id", repr(self.env_id), "spaces too, or neither"
        )
        low, high = (1, 4096) if joins else (0, 0)
        require(low <= self.num_envs <= high, "hello: num_envs", self.num_envs, f"{low}..{high}")
        require(-1 <= self.slot < _MOST_SLOTS, "hello: slot", self.slot, f"-1..{_MOST_SLOTS - 1}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Welcome:
    """The learner's answer to a hello: the run, and the actor's part in it.

    Attributes:
        run: Name of the run.
        generation: Which start of the learner this is, counting from 1.
        env_id: Environment to make.
        spaces: Spaces that this environment must have.
        num_envs: Environments to step unless the actor was told otherwise.
        clock: ``lockstep``: play the quota, then wait for the next version; ``async``: go on.
        slot: The actor's place in the run, unique among those present; -1 while it only asks.
        seed: Seed for this actor's environments and noise; while it only asks, the seed of all
            that is random before it has joined.
        env: How to make the environment; ``None``: with its id alone.
    """

    run: str
    generation: int
    env_id: str
    spaces: Spaces
    num_envs: int
    clock: Clock
    slot: int
    seed: int
    env: EnvConfig | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refusal:
    """The learner's answer to a hello that cannot be welcomed: ``reason`` is one line."""

    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeMetric:
    """A number that the environment told at the end of an episode, such as ``is_success``."""

    name: str
    value: float

    def __post_init__(self) -> None:
        """Check that it has a name and is a number."""
        require(is_metric_name(self.name), "metric: name", repr(self.name), METRIC_NAME)
        require(math.isfinite(self.value), f"metric {self.name}", self.value, "a finite number")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segment:
    """A run of consecutive steps of one episode, made with one version of the weights.

    Step ``t`` is read left to right: seeing ``obs[t]`` the actor executed ``suggestion[t]`` and
    received ``reward[t]``. ``final_obs`` is what it saw after the last step, never the first
    observation of the next episode.

    Attributes:
        actor: Sender, as in its hello.
        seq: Number of this segment among those of the sender, 0, 1, 2...
        generation: Generation of the learner that sent the weights.
        epoch: Recovery epoch of the weights.
        weights_version: Version of the weights that chose every action here.
        env: Index of the environment within the actor.
        obs: Observations, float32 ``[T, D]``.
        suggestion: Executed suggestions in canonical coordinates (-1..1 spans the action
            bounds), before they were clipped, float32 ``[T, A]``.
        log_prob: Log density of the suggestion as executed, float32 ``[T]``.
        reward: Undiscounted rewards, float32 ``[T]``.
        final_obs: Observation after the last step, float32 ``[D]``.
        terminated: The last step reached a terminal state, so ``final_obs`` has value 0.
        truncated: The episode was cut after the last step, by a time limit or because the next
            step cannot be used, so ``final_obs`` is bootstrapped.
        episode_return: Sum of rewards since the episode began, this segment included.
        episode_length: Steps since the episode began, this segment included.
        metrics: What the environment told of the episode that ends here, at most 32 numbers.

    Raises:
        MalformedMessageError: The arrays disagree, or a number is too large, or none.
    """

    actor: str
    seq: int
    generation: int
    epoch: int
    weights_version: int
    env: int
    obs: Array
    suggestion: Array
    log_prob: Array
    reward: Array
    final_obs: Array
    terminated: bool
    truncated: bool
    episode_return: float
    episode_length: int
    metrics: tuple[EpisodeMetric, ...] = ()

    def __post_init__(self) -> None:
        """Check the shapes against each other and the size of every number."""
        subject = f"segment {self.actor}/{self.seq}"
        require(is_name(self.actor), "segment: actor", repr(self.actor), NAME)
        require(self.obs.ndim == 2 and self.obs.size > 0, subject, self.obs.shape, "obs [T, D]")
        steps, obs_size = self.obs.shape
        require(self.suggestion.ndim == 2, subject, self.suggestion.shape, "suggestion [T, A]")
        lengths = {
            "obs": steps,
            "suggestion": len(self.suggestion),
            "log_prob": self.log_prob.shape,
            "reward": self.reward.shape,
        }
        agree = self.log_prob.shape == self.reward.shape == (steps,)
        agree = agree and len(self.suggestion) == steps
        require(agree, f"{subject}: arrays disagree about T", lengths, "one length")
        final = self.final_obs.shape
        require(final == (obs_size,), f"{subject}: final_obs", final, f"({obs_size},) as in obs")
        require(not (self.terminated and self.truncated), subject, "both ends", "one of them")
        for name in ("seq", "generation", "epoch", "weights_version", "env"):
            require(getattr(self, name) >= 0, f"{subject}: {name}", getattr(self, name), ">= 0")
        require(self.episode_length >= steps, subject, self.episode_length, "episode_length >= T")
        told = len(self.metrics)
        require(told <= MOST_METRICS, f"{subject}: metrics", told, f"at most {MOST_METRICS}")
        for names, most in (
            (("obs", "final_obs", "reward", "episode_return"), MOST_PLAYED),
            (("suggestion", "log_prob"), MOST_SUGGESTED),
        ):
            for name in names:
                largest = float(np.max(np.abs(getattr(self, name)), initial=0.0))
                fits = largest <= most  # false for NaN
                require(fits, f"{subject}: {name}", largest, f"at most {most:g} in size")

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.reward)

    @property
    def ends_episode(self) -> bool:
        """Whether the episode ended with the last step."""
        return self.terminated or self.truncated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ack:
    """The learner's answer to a segment; unless it is ``unknown``, the actor forgets the segment.

    Attributes:
        verdict: ``accepted`` (will be learned from), ``duplicate`` (was answered before),
            ``stale`` (too old to learn from), ``refused`` (unusable), ``unknown`` (the sender is
            not on the roster: it says hello again, then sends the segment again).
        reason: Why, when it is not accepted; one line.
        generation: Generation of the answering learner; another one than the segment's means:
            say hello again.
        epoch: Current recovery epoch.
        weights_version: Newest version.
        wait_s: Seconds to hold back before the next segment, 0 when there is no hurry to hold.
    """

    verdict: Verdict
    reason: str
    generation: int
    epoch: int
    weights_version: int
    wait_s: float

    def __post_init__(self) -> None:
        """Check the wait."""
        require(0 <= self.wait_s < math.inf, "ack: wait_s", self.wait_s, "0 or more seconds")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Notice:
    """What the newest weights are, and how much is to be played with them.

    Attributes:
        generation: Which start of the learner published them.
        epoch: Counts recoveries.
        version: Counts published weights.
        quota_steps: Steps that each environment plays with them in lockstep; the longest
            segment in async.
        quota_episodes: Whole episodes that each environment plays at least; 0: episodes are
            cut where the quota of steps is reached.
        num_bytes: Size of the graph.
        sha256: Checksum of the graph, hexadecimal.
    """

    generation: int
    epoch: int
    version: int
    quota_steps: int
    quota_episodes: int
    num_bytes: int
    sha256: str

    def __post_init__(self) -> None:
        """Check that the quota asks for something."""
        require(self.quota_steps >= 1, "notice: quota_steps", self.quota_steps, "at least 1")

    @property
    def identity(self) -> tuple[int, int]:
        """Generation and version: what makes two weights the same."""
        return (self.generation, self.version)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """A notice and its ONNX graph."""

    notice: Notice
    graph: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecoveryEvent:
    """The learner went back to its best networks (equation 5 of the paper).

    Attributes:
        id: Counts the recoveries of the run from 1.
        generation: Which start of the learner decided.
        epoch: Epoch that begins with this event.
        draw: The uniform random number of the test.
        probability: Chance of recovery at these returns.
        r: Return statistic of the latest batch.
        r_best: The best statistic so far, r*.
        restored_version: Version whose networks were restored.
        weights_version: Version under which they are published again.
    """

    id: int
    generation: int
    epoch: int
    draw: float
    probability: float
    r: float
    r_best: float
    restored_version: int
    weights_version: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActorStatus:
    """One actor's own account, published every second and when it leaves.

    Attributes:
        actor: As in its hello.
        slot: Place in the run; -1 before it has joined.
        weights_version: Version that it acts with.
        epoch: Recovery epoch that it acts in.
        env_steps: Steps it has made.
        episodes: Episodes it has finished.
        segments_sent: Segments handed to its sender.
        segments_answered: Those that the learner has answered.
        spooled_steps: Steps waiting for an answer.
        leaving: Nothing more will come from it.
        doing: The call into an environment that it is in, and for how long; empty if in none.
        dropped_steps: Steps whose numbers could not be used.
        trouble: The latest of them, or the latest episode that was cut because it did not end,
            in one line; empty if there was none.
    """

    actor: str
    slot: int
    weights_version: int
    epoch: int
    env_steps: int
    episodes: int
    segments_sent: int
    segments_answered: int
    spooled_steps: int
    leaving: bool
    doing: str = ""
    dropped_steps: int = 0
    trouble: str = ""

    def __post_init__(self) -> None:
        """Check the name: it is shown, and who has not joined is remembered by it."""
        require(is_name(self.actor), "actor status: actor", repr(self.actor), NAME)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunStatus:
    """One look at a live run, answered by the learner."""

    run: str
    generation: int
    env_id: str
    env_steps: int
    total_steps: int
    episodes: int
    updates: int
    weights_version: int
    epoch: int
    return_mean: float
    env_steps_per_s: float
    waiting_for: str
    actors: tuple[ActorStatus, ...]
