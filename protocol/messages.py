"""The messages that cross the network.

A message is an immutable record of arrays and scalars: it knows its own consistency rules and
nothing of transport, tensors or files. ``docs/protocol.md`` gives the same list byte for byte.
The letters in the shapes are used throughout a2s::

    T  time steps in one segment      D  observation size
    K  suggestions per observation    A  action size
"""

import math
import re
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from a2s.protocol.errors import MalformedMessageError

Array = npt.NDArray[np.float32]
Clock = Literal["lockstep", "async"]
Verdict = Literal["accepted", "duplicate", "stale", "refused", "unknown"]
Column = Literal["obs", "action", "reward", "next_obs", "discount", "weight", "row"]
COLUMNS: tuple[Column, ...] = get_args(Column)
MOST_SAMPLED = 4096
MOST_STEPS = 64

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}")


def is_name(text: str) -> bool:
    """Tell whether a run or actor name can be part of a key: letters, digits, ``_ . -``."""
    return _NAME.fullmatch(text) is not None


def _require(condition: bool, subject: str, found: object, expected: str) -> None:
    if not condition:
        raise MalformedMessageError(f"{subject}: found {found!s:.100}, expected {expected}")


def _require_finite(subject: str, **arrays: Array) -> None:
    for name, array in arrays.items():
        bad = int(array.size - np.isfinite(array).sum())
        _require(bad == 0, f"{subject}: {name}", f"{bad} non-finite values", "finite numbers")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spaces:
    """The flat Box spaces of an environment.

    Attributes:
        obs_size: D.
        action_low: Lowest action, in the environment's units, float32 ``[A]``.
        action_high: Highest action, float32 ``[A]``.

    Raises:
        MalformedMessageError: No dimensions, or bounds that are not finite and ordered.
    """

    obs_size: int
    action_low: Array
    action_high: Array

    def __post_init__(self) -> None:
        """Check the sizes and the order of the bounds."""
        low, high = self.action_low, self.action_high
        _require(self.obs_size > 0, "spaces: obs_size", self.obs_size, "at least 1")
        _require(low.ndim == 1 and low.size > 0, "spaces: action_low", low.shape, "shape [A]")
        _require(low.shape == high.shape, "spaces: action_high", high.shape, f"{low.shape}")
        _require_finite("spaces", action_low=low, action_high=high)
        _require(bool((low < high).all()), "spaces", "low >= high", "low below high everywhere")

    @property
    def action_size(self) -> int:
        """A."""
        return int(self.action_low.size)

    def differs_from(self, other: "Spaces") -> str:
        """Describe the first difference to another environment's spaces, or return ``""``."""
        if self.obs_size != other.obs_size:
            return f"obs_size {other.obs_size}, expected {self.obs_size}"
        if self.action_size != other.action_size:
            return f"action_size {other.action_size}, expected {self.action_size}"
        for name in ("action_low", "action_high"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if not np.array_equal(mine, theirs):
                return f"{name} {theirs.tolist()}, expected {mine.tolist()}"
        return ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hello:
    """An actor asks for work, and after it has made the environment, joins.

    Attributes:
        actor: Unique name of this actor process (a restarted process has a new one).
        num_envs: Environments that it steps; 0 while it only asks.
        env_id: Environment that it has made; empty while it only asks.
        spaces: Their spaces; ``None`` while it only asks.
    """

    actor: str
    num_envs: int
    env_id: str
    spaces: Spaces | None

    def __post_init__(self) -> None:
        """Check the name and that a joining actor says everything."""
        _require(is_name(self.actor), "hello: actor", repr(self.actor), "letters, digits, _ . -")
        joins = self.spaces is not None
        _require(joins == bool(self.env_id), "hello: env_id", repr(self.env_id), "both or neither")
        low, high = (1, 4096) if joins else (0, 0)
        _require(low <= self.num_envs <= high, "hello: num_envs", self.num_envs, f"{low}..{high}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Welcome:
    """The learner's answer to a hello: the run, and the actor's part in it.

    Attributes:
        run: Name of the run.
        generation: Which start of the learner this is, counting from 1.
        env_id: Gymnasium id to make.
        spaces: Spaces that this environment must have.
        num_envs: Environments to step unless the actor was told otherwise.
        clock: ``lockstep``: play the quota, then wait for the next version; ``async``: never wait.
        slot: The actor's place in the run, unique among those present; -1 while it only asks.
        seed: Seed for this actor's environments and noise.
    """

    run: str
    generation: int
    env_id: str
    spaces: Spaces
    num_envs: int
    clock: Clock
    slot: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refusal:
    """The learner's answer to a hello that cannot be welcomed: ``reason`` is one line."""

    reason: str


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
        truncated: The last step hit a time limit, so ``final_obs`` is bootstrapped.
        episode_return: Sum of rewards since the episode began, this segment included.
        episode_length: Steps since the episode began, this segment included.

    Raises:
        MalformedMessageError: The arrays disagree, or a number is not finite.
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

    def __post_init__(self) -> None:
        """Check the shapes against each other and every number for being finite."""
        subject = f"segment {self.actor}/{self.seq}"
        _require(is_name(self.actor), "segment: actor", repr(self.actor), "letters, digits, _ . -")
        _require(self.obs.ndim == 2 and self.obs.size > 0, subject, self.obs.shape, "obs [T, D]")
        steps, obs_size = self.obs.shape
        _require(self.suggestion.ndim == 2, subject, self.suggestion.shape, "suggestion [T, A]")
        lengths = {
            "obs": steps,
            "suggestion": len(self.suggestion),
            "log_prob": self.log_prob.shape,
            "reward": self.reward.shape,
        }
        agree = self.log_prob.shape == self.reward.shape == (steps,)
        agree = agree and len(self.suggestion) == steps
        _require(agree, f"{subject}: arrays disagree about T", lengths, "one length")
        _require(
            self.final_obs.shape == (obs_size,), subject, self.final_obs.shape, "final_obs [D]"
        )
        _require(not (self.terminated and self.truncated), subject, "both ends", "one of them")
        for name in ("seq", "generation", "epoch", "weights_version", "env"):
            _require(getattr(self, name) >= 0, f"{subject}: {name}", getattr(self, name), ">= 0")
        _require(self.episode_length >= steps, subject, self.episode_length, "episode_length >= T")
        _require(math.isfinite(self.episode_return), subject, self.episode_return, "finite return")
        _require_finite(
            subject,
            obs=self.obs,
            suggestion=self.suggestion,
            log_prob=self.log_prob,
            reward=self.reward,
            final_obs=self.final_obs,
        )

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
        _require(0 <= self.wait_s < math.inf, "ack: wait_s", self.wait_s, "0 or more seconds")


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
        _require(self.quota_steps >= 1, "notice: quota_steps", self.quota_steps, "at least 1")

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
        slot: Place in the run.
        weights_version: Version that it acts with.
        epoch: Recovery epoch that it acts in.
        env_steps: Steps it has made.
        episodes: Episodes it has finished.
        segments_sent: Segments handed to its sender.
        segments_answered: Those that the learner has answered.
        spooled_steps: Steps waiting for an answer.
        leaving: Nothing more will come from it.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayInfo:
    """What a served replay holds now.

    Attributes:
        run: Name of the run.
        generation: Which start of the learner serves it.
        env_id: Environment of the transitions.
        spaces: Its spaces.
        capacity: Transitions that it holds at most.
        begin: Number of the oldest row that can be sampled.
        end: Rows ever inserted, and so the number of the next.
    """

    run: str
    generation: int
    env_id: str
    spaces: Spaces
    capacity: int
    begin: int
    end: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRequest:
    """Somebody asks for a batch of transitions.

    Attributes:
        batch_size: B, 1 to 4096.
        seed: Of the draw: while nothing is inserted and no priority changes, the same request is
            answered by the same batch.
        n_step: Steps that a transition goes over at most, 1 to 64.
        gamma: Discount of one step, 0 to 1.
        prioritised: Draw in proportion to the priorities, else uniformly.
        beta: How far importance weights make up for that, 0 to 1.
        fields: What is wanted of each transition, at least one.

    Raises:
        MalformedMessageError: A number is out of its range, or a field comes twice.
    """

    batch_size: int
    seed: int
    n_step: int
    gamma: float
    prioritised: bool
    beta: float
    fields: tuple[Column, ...]

    def __post_init__(self) -> None:
        """Check that the work is bounded."""
        subject = "replay request"
        size, steps, names = self.batch_size, self.n_step, self.fields
        _require(1 <= size <= MOST_SAMPLED, f"{subject}: batch_size", size, f"1..{MOST_SAMPLED}")
        _require(0 <= self.seed < 1 << 63, f"{subject}: seed", self.seed, "0 to 2^63 - 1")
        _require(1 <= steps <= MOST_STEPS, f"{subject}: n_step", steps, f"1..{MOST_STEPS}")
        _require(0.0 <= self.gamma <= 1.0, f"{subject}: gamma", self.gamma, "0 to 1")
        _require(0.0 <= self.beta <= 1.0, f"{subject}: beta", self.beta, "0 to 1")
        once = len(names) == len(set(names)) > 0
        _require(once, f"{subject}: fields", names, "at least one, none twice")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplaySample:
    """A batch of transitions; what was not asked for is missing.

    The target of a value at ``(obs, action)`` is ``reward + discount * value(next_obs)``.

    Attributes:
        begin: Number of the oldest row when it was drawn.
        end: Number of the row that was to come next.
        obs: Observation before the first step, float32 ``[B, D]``.
        action: The first step's executed suggestion, canonical, not clipped, float32 ``[B, A]``.
        reward: Discounted sum of the rewards of the steps, float32 ``[B]``.
        next_obs: Observation after the last step, float32 ``[B, D]``.
        discount: gamma to the number of steps; 0 where the last one terminated, float32 ``[B]``.
        weight: Importance weight, the highest is 1, float32 ``[B]``.
        row: Number of the first step's row, B of them, or none.

    Raises:
        MalformedMessageError: The columns disagree about B, or a number is not finite.
    """

    begin: int
    end: int
    obs: Array | None
    action: Array | None
    reward: Array | None
    next_obs: Array | None
    discount: Array | None
    weight: Array | None
    row: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the columns against each other."""
        arrays: dict[str, Array] = {
            name: array for name in COLUMNS[:-1] if (array := getattr(self, name)) is not None
        }
        lengths = {name: len(array) for name, array in arrays.items()}
        if self.row:
            lengths["row"] = len(self.row)
        agree = len(set(lengths.values())) == 1
        _require(agree, "replay sample: columns disagree about B", lengths, "one length")
        for name, array in arrays.items():
            rank = 2 if name in ("obs", "action", "next_obs") else 1
            _require(array.ndim == rank, f"replay sample: {name}", array.shape, f"rank {rank}")
        _require_finite("replay sample", **arrays)


Message = (
    Hello
    | Welcome
    | Refusal
    | Segment
    | Ack
    | Notice
    | Weights
    | RecoveryEvent
    | ActorStatus
    | RunStatus
    | ReplayInfo
    | ReplayRequest
    | ReplaySample
)
