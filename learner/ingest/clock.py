"""The two clocks of a run: when a batch is complete, and whether actors wait for weights."""

from dataclasses import dataclass, field

from a2s.learner.feed import Arrival
from a2s.learner.ingest.members import JUST_BEGUN, SILENT_S, Member
from a2s.protocol import messages
from a2s.protocol.messages import Notice

_MAX_BATCHES = 4
_PATIENCE = 10
STALLED_S = 300.0


@dataclass(slots=True, kw_only=True)
class Round:
    """The batch that is played now.

    Attributes:
        notice: Of the newest weights, with the quota.
        batch_steps: Steps wanted.
        published_s: When the weights came out, on the monotonic clock.
        arrivals: Accepted segments.
        steps: Steps of the arrivals.
    """

    notice: Notice
    batch_steps: int
    published_s: float
    arrivals: list[Arrival] = field(default_factory=list)
    steps: int = 0

    @property
    def epoch(self) -> int:
        """Of all its arrivals."""
        return self.notice.epoch

    @property
    def num_batches(self) -> float:
        """Number of complete batches among the arrivals."""
        return self.steps / self.batch_steps


class Lockstep:
    """One version, one batch: complete when every actor present has played the quota.

    Actors play their quota, then wait for the next version: ``waits_for_weights``.
    """

    waits_for_weights = True

    def is_filled(self, played: Round) -> bool:
        """Never complete before every actor is done: a quota is always taken whole."""
        return False

    def is_flooded(self, played: Round) -> bool:
        """Whether more waits than can be learned from in time: never, for the same reason."""
        return False

    def stalled(
        self, played: Round, members: list[Member], now_s: float, timeout_s: float
    ) -> list[Member]:
        """Who owes the batch something that is not to be expected any more.

        An actor that reports a call into an environment has as long as each of its environments
        may take, ``timeout_s``.
        """
        return [m for m in members if self._is_stalled(m, played, now_s, timeout_s)]

    def _is_stalled(self, member: Member, played: Round, now_s: float, timeout_s: float) -> bool:
        if member.has_delivered(played.notice):
            return False
        is_inside = member.status is not None and member.status.doing
        limit_s = max(STALLED_S, member.num_envs * timeout_s if is_inside else 0.0)
        return member.idle_s(played.notice, played.published_s, now_s) > limit_s

    def missing(self, played: Round, members: list[Member], now_s: float) -> str:
        """What the batch waits for, given which actors were heard; "" if it is complete.

        Late actors are waited for, unless they need ten times as long as all others.
        """
        late = [m for m in members if not m.has_delivered(played.notice)]
        done_s = [m.done_s - played.published_s for m in members if m not in late]
        waited_s = now_s - played.published_s
        if late and not (done_s and waited_s > max(SILENT_S, _PATIENCE * max(done_s))):
            slots = [m.slot for m in late]
            return f"segments of version {played.notice.version} from actors {slots}{_doing(late)}"
        return "" if played.arrivals else "segments"


class Async:
    """Actors do not wait for weights: a batch is complete at its number of steps."""

    waits_for_weights = False

    def is_filled(self, played: Round) -> bool:
        """Whether it has its number of steps."""
        return played.steps >= played.batch_steps

    def is_flooded(self, played: Round) -> bool:
        """Whether four batches wait."""
        return played.num_batches >= _MAX_BATCHES

    def stalled(
        self, played: Round, members: list[Member], now_s: float, timeout_s: float
    ) -> list[Member]:
        """Nobody: nobody is waited for."""
        return []

    def missing(self, played: Round, members: list[Member], now_s: float) -> str:
        """What an unfilled batch waits for: the rest of its steps."""
        return f"{played.batch_steps - played.steps} more steps{_doing(members)}"


Clock = Lockstep | Async


def clock_of(name: messages.Clock) -> Clock:
    """Make the clock that a run is configured for."""
    return Lockstep() if name == "lockstep" else Async()


def _doing(members: list[Member]) -> str:
    """Say which call into an environment keeps the first of some members, if one does."""
    for member in members:
        if member.status is not None and member.status.doing:
            return f", actor {member.slot}: {member.status.doing.removesuffix(JUST_BEGUN)}"
    return ""
