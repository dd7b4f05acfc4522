"""The messages that cross the network; ``docs/protocol.md`` explains every field.

A message checks its own values. It knows nothing of transport, tensors or files.
The letters in the shapes are used throughout a2s::

    T  time steps in one segment      D  observation size
    K  suggestions per observation    A  action size
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from a2s.protocol.checks import (
    MAX_METRICS,
    METRIC_NAME,
    NAME,
    is_metric_name,
    is_name,
    require,
    require_counts,
)
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Array, Spaces, is_within

Clock = Literal["lockstep", "async"]
Verdict = Literal["accepted", "duplicate", "stale", "refused", "unknown"]

# Larger finite numbers have infinite sums and squares, and would end the learning as well.
MAX_PLAYED = 1e10  # as in MuJoCo, which resets a simulation beyond it
MAX_SUGGESTED = 1e6
# An episode of a batch of whole ones is cut after this many steps, if nothing else ever ends it.
ENDLESS_STEPS = 10_000
MAX_ENVS = 4096  # of an actor
MAX_WINDOW = 1000
_MAX_SLOT = 999_999
_MAX_WAIT_S = 1e6
_HEX = 64  # digits of a checksum
_COUNTED = (
    "weights_version", "epoch", "env_steps", "episodes", "segments_sent", "segments_answered",
    "spooled_steps", "dropped_steps",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hello:
    """An actor asks for work and, once it has made its environments, joins.

    While it only asks, ``num_envs`` is 0, ``env_id`` empty and ``spaces`` ``None``.
    """

    actor: str  # unique; a restarted process has a new one
    num_envs: int
    env_id: str
    spaces: Spaces | None
    cause: str = ""  # why the process before it had to be replaced; empty: there was none
    slot: int = -1  # the slot that it wants, so that runs repeat whoever joins first; -1: any
    next_seq: int = -1  # of its oldest unanswered segment, the first of an order; -1: no order

    def __post_init__(self) -> None:
        """Check the name, and that a joining actor says everything."""
        require(is_name(self.actor), "hello: actor", repr(self.actor), NAME)
        joins = self.spaces is not None
        complete = joins == bool(self.env_id)
        require(complete, "hello: env_id", repr(self.env_id), "spaces too, or neither")
        low, high = (1, MAX_ENVS) if joins else (0, 0)
        require(low <= self.num_envs <= high, "hello: num_envs", self.num_envs, f"{low}..{high}")
        _require_slot("hello", self.slot)
        require(self.next_seq >= -1, "hello: next_seq", self.next_seq, "-1 or more")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Welcome:
    """The learner's answer to a hello: the run, and the actor's part in it."""

    run: str
    generation: int  # of the learner; see generations.py
    env_id: str
    spaces: Spaces
    num_envs: int  # unless the actor was told otherwise
    clock: Clock  # lockstep: play the quota, then wait for the next version; async: go on
    slot: int  # unique among the actors present; -1 while it only asks
    seed: int  # of environments and noise; while it only asks, of what is random before it joins
    env: EnvConfig | None = None  # None: made with its id alone
    window: int = 1  # segments that may be unanswered at a time, by an actor that says its next_seq
    short_steps: int = 0  # of the short episodes between whole ones; 0: there are none

    def __post_init__(self) -> None:
        """Check the numbers and the name."""
        require(is_name(self.run), "welcome: run", repr(self.run), NAME)
        found = self.num_envs
        require(1 <= found <= MAX_ENVS, "welcome: num_envs", found, f"1..{MAX_ENVS}")
        require_counts("welcome", self, "generation", "seed", "short_steps")
        require(1 <= self.window <= MAX_WINDOW, "welcome: window", self.window, f"1..{MAX_WINDOW}")
        _require_slot("welcome", self.slot)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refusal:
    """The answer to a hello or a request that cannot be met: ``reason`` is one line."""

    reason: str
    retry_s: float = 0.0  # after which it may be asked again; 0: never

    def __post_init__(self) -> None:
        """Check the wait."""
        fits = 0 <= self.retry_s <= _MAX_WAIT_S  # false for NaN
        require(fits, "refusal: retry_s", self.retry_s, f"0 to {_MAX_WAIT_S:g} seconds")


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeMetric:
    """A number from the environment at the end of an episode, such as ``is_success``."""

    name: str
    value: float

    def __post_init__(self) -> None:
        """Check name and value."""
        require(is_metric_name(self.name), "metric: name", repr(self.name), METRIC_NAME)
        require(math.isfinite(self.value), f"metric {self.name}", self.value, "a finite number")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segment:
    """Consecutive steps of one episode, made with one version of the weights.

    Step ``t`` is read left to right: seeing ``obs[t]`` the actor executed ``suggestion[t]`` and
    received ``reward[t]``. Arrays are float32.
    """

    actor: str
    seq: int  # counts the segments of this actor from 0
    generation: int  # of the weights that chose every action here, as the next two
    epoch: int
    weights_version: int
    env: int  # index of the environment within the actor
    obs: Array  # [T, D]
    suggestion: Array  # [T, A], canonical (-1..1 spans the action bounds), before it was clipped
    log_prob: Array  # [T], log density of the suggestion as executed
    reward: Array  # [T], undiscounted
    final_obs: Array  # [D], after the last step; never the first one of the next episode
    terminated: bool  # the last step reached a terminal state: final_obs has value 0
    truncated: bool  # cut by a time limit or before a step that is unusable: bootstrap final_obs
    episode_return: float  # sum of rewards since the episode began, this segment included
    episode_length: int  # steps since the episode began, this segment included
    metrics: tuple[EpisodeMetric, ...] = ()  # of the episode that ends here
    short: bool = False  # of a short episode: it is learned from, and its return is nobody's

    def __post_init__(self) -> None:
        """Check the shapes against each other, and every number."""
        require(is_name(self.actor), "segment: actor", repr(self.actor), NAME)
        subject = f"segment {self.actor}/{self.seq}"
        self._check_shapes(subject)
        require(not (self.terminated and self.truncated), subject, "both ends", "one of them")
        require_counts(subject, self, "seq", "generation", "epoch", "weights_version", "env")
        length = self.episode_length
        require(length >= self.num_steps, subject, length, "episode_length >= T")
        count = len(self.metrics)
        require(count <= MAX_METRICS, f"{subject}: metrics", count, f"at most {MAX_METRICS}")
        fits = abs(self.episode_return) <= MAX_PLAYED  # false for NaN
        most = f"at most {MAX_PLAYED:g} in size"
        require(fits, f"{subject}: episode_return", abs(self.episode_return), most)
        for name in ("obs", "final_obs", "reward"):
            self._check_size(subject, name, MAX_PLAYED)
        for name in ("suggestion", "log_prob"):
            self._check_size(subject, name, MAX_SUGGESTED)

    def _check_shapes(self, subject: str) -> None:
        require(self.obs.ndim == 2 and self.obs.size > 0, subject, self.obs.shape, "obs [T, D]")
        steps, obs_size = self.obs.shape
        require(self.suggestion.ndim == 2, subject, self.suggestion.shape, "suggestion [T, A]")
        lengths = steps, len(self.suggestion), self.log_prob.shape, self.reward.shape
        if lengths != (steps, steps, (steps,), (steps,)):
            found = dict(zip(("obs", "suggestion", "log_prob", "reward"), lengths, strict=True))
            require(False, f"{subject}: arrays disagree about T", found, "one length")
        final = self.final_obs.shape
        require(final == (obs_size,), f"{subject}: final_obs", final, f"({obs_size},) as in obs")

    def _check_size(self, subject: str, name: str, most: float) -> None:
        found = getattr(self, name)
        if not is_within(found, most):
            largest = float(np.abs(found).max())
            require(False, f"{subject}: {name}", largest, f"at most {most:g} in size")

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
    """The learner's answer to a segment; the actor then forgets it, unless it is ``unknown``.

    ``accepted``: will be learned from; ``duplicate``: was answered before; ``stale``: too old to
    learn from; ``refused``: unusable; ``unknown``: the sender is no member, so it says hello again
    and sends the segment again.
    """

    verdict: Verdict
    reason: str  # why it is not accepted, in one line
    generation: int  # of this learner; if not the segment's, the actor says hello again
    epoch: int  # current recovery epoch
    weights_version: int  # newest version
    wait_s: float  # to hold the next segment back

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_counts("ack", self, "generation", "epoch", "weights_version")
        fits = 0 <= self.wait_s <= _MAX_WAIT_S  # false for NaN
        require(fits, "ack: wait_s", self.wait_s, f"0 to {_MAX_WAIT_S:g} seconds")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Notice:
    """Which weights are the newest, and how much to play with them."""

    generation: int  # of the learner that published them
    epoch: int  # counts recoveries
    version: int  # counts published weights
    quota_steps: int  # per environment in lockstep; the longest segment in async
    quota_episodes: int  # whole episodes per environment; 0: cut where quota_steps is reached
    num_bytes: int  # of the graph
    sha256: str  # of the graph, hexadecimal

    def __post_init__(self) -> None:
        """Check the numbers, and that the quota asks for something."""
        require(self.quota_steps >= 1, "notice: quota_steps", self.quota_steps, "at least 1")
        require_counts("notice", self, "generation", "epoch", "version", "quota_episodes")
        require_counts("notice", self, "num_bytes")
        require(len(self.sha256) <= _HEX, "notice: sha256", repr(self.sha256), f"{_HEX} digits")

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
    """The learner went back to its best networks (equation 5 of the paper)."""

    id: int  # counts the recoveries of the run from 1
    generation: int
    epoch: int  # begins with this event
    draw: float  # the uniform random number of the test
    probability: float  # of recovery at these returns
    r: float  # return statistic of the latest batch
    r_best: float  # r*, the best so far
    restored_version: int
    weights_version: int  # under which the restored networks are published again

    def __post_init__(self) -> None:
        """Check the counts; what is not known is NaN."""
        names = ("id", "generation", "epoch", "restored_version", "weights_version")
        require_counts("recovery", self, *names)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActorStatus:
    """One actor's own account, published every second and when it leaves."""

    actor: str
    slot: int  # -1 before it has joined
    weights_version: int
    epoch: int
    env_steps: int
    episodes: int
    segments_sent: int
    segments_answered: int
    spooled_steps: int  # waiting for an answer
    leaving: bool
    doing: str = ""  # the call into an environment that it is in, and for how long; empty: none
    dropped_steps: int = 0  # steps whose numbers could not be used
    trouble: str = ""  # the latest dropped step or cut episode in one line; empty: none
    environment_s: float = 0.0  # seconds so far in which environments were stepped
    selection_s: float = 0.0  # the same: actions were chosen
    sending_s: float = 0.0  # there was no room for a segment
    waiting_s: float = 0.0  # there were no new weights

    def __post_init__(self) -> None:
        """Check what is shown, and kept before the actor has joined."""
        require(is_name(self.actor), "actor status: actor", repr(self.actor), NAME)
        _require_slot("actor status", self.slot)
        require_counts("actor status", self, *_COUNTED)
        for name in ("environment_s", "selection_s", "sending_s", "waiting_s"):
            found = getattr(self, name)
            fits = 0 <= found < math.inf
            require(fits, f"actor status: {name}", found, "0 or more seconds")


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
    learning_s: float = 0.0  # seconds of this learner so far in which it did not wait for a batch
    limited_by: str = ""  # learner, environment, selection or network; empty: not known yet
    unix_s: float = 0.0  # the learner's clock when it answered; 0: not told
    evaluation_return: float = 0.0  # mean return of the latest evaluation
    evaluation_steps: int = 0  # of the run, when it had those weights; 0: there was no evaluation
    variant: str = ""  # on-policy or off-policy; empty: not told
    ended: str = ""  # why the run has ended; empty: it has not

    def __post_init__(self) -> None:
        """Check what is counted."""
        counted = ("generation", "env_steps", "episodes", "updates", "weights_version", "epoch")
        require_counts("run status", self, *counted, "evaluation_steps")
        require(self.total_steps >= 1, "run status: total_steps", self.total_steps, "at least 1")


def _require_slot(subject: str, slot: int) -> None:
    require(-1 <= slot <= _MAX_SLOT, f"{subject}: slot", slot, f"-1..{_MAX_SLOT}")
