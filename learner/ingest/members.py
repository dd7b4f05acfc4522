"""The actors of a run: those present, those coming, and the deliveries of each."""

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from a2s.protocol.generations import start_of
from a2s.protocol.messages import ENDLESS_STEPS, ActorStatus, Hello, Notice, Segment

SILENT_S = 30.0
JUST_BEGUN = " for 0 s"  # what an actor says of a call that has lasted for less than a second
MAX_SEEN = 1 << 16  # tokens
_MAX_MEMBERS, _MAX_ENVS = 4096, 1 << 16
_MAX_AWAY = 256
_MAX_REMEMBERED = 4096

T = TypeVar("T")


@dataclass(slots=True)
class _Delivered:
    """The deliveries of one environment with the newest weights."""

    steps: int = 0
    episodes: int = 0
    at_end: bool = True

    def meets(self, notice: Notice) -> bool:
        """Whether the quota is played."""
        if self.steps < notice.quota_steps:
            return False
        return not notice.quota_episodes or (self.episodes >= notice.quota_episodes and self.at_end)


@dataclass(slots=True)
class Member:
    """One actor that has joined.

    Attributes:
        slot: Its place.
        heard_s: When it was last heard, on the monotonic clock.
        done_s: When its quota was complete, on the same clock.
        status: Its latest status.
        delivered_s: When it joined or delivered last, on the same clock.
        moved_s: When it reported more steps last, on the same clock.
        said: The latest trouble that was passed on, and the steps that it had dropped by then.
        next_seq: Number of its next segment, if it sends several at a time.
    """

    actor: str
    slot: int
    num_envs: int
    heard_s: float
    done_s: float = 0.0
    status: ActorStatus | None = None
    delivered_s: float = 0.0
    moved_s: float = 0.0
    said: tuple[str, int] = ("", 0)
    next_seq: int | None = None
    _delivered: list[_Delivered] = field(default_factory=list)
    _steps_then: int = 0  # that it had reported when it delivered last

    def __post_init__(self) -> None:
        """Begin with nothing delivered."""
        self.begin()

    def begin(self) -> None:
        """Forget what was delivered: new weights are out."""
        self._delivered = [_Delivered() for _ in range(self.num_envs)]

    def deliver(self, segment: Segment) -> None:
        """Count a segment that was made with the newest weights."""
        delivered = self._delivered[segment.env]
        delivered.steps += segment.num_steps
        delivered.episodes += segment.ends_episode
        delivered.at_end = segment.ends_episode

    def has_delivered(self, notice: Notice) -> bool:
        """Whether every environment has played the quota."""
        return all(delivered.meets(notice) for delivered in self._delivered)

    def hear(self, status: ActorStatus, now_s: float) -> None:
        """Remember its status."""
        if self.status is None or status.env_steps > self.status.env_steps:
            self.moved_s = now_s
        self.status, self.heard_s = status, now_s

    def is_early(self, seq: int) -> bool:
        """Whether a segment has overtaken another."""
        return self.next_seq is not None and seq > self.next_seq

    def answer(self, seq: int) -> None:
        """A segment of it is answered."""
        if self.next_seq is not None:
            self.next_seq = max(self.next_seq, seq + 1)

    def has_sent(self, now_s: float) -> None:
        """It has delivered something."""
        self.delivered_s = now_s
        self._steps_then = self.status.env_steps if self.status else 0

    def idle_s(self, notice: Notice, published_s: float, now_s: float) -> float:
        """Seconds since anything came of the quota: a segment, or a report of more steps.

        Reports count up to twice the quota: who plays more than that and sends nothing is idle.
        """
        per_env = max(notice.quota_steps, ENDLESS_STEPS if notice.quota_episodes else 0)
        unsent = (self.status.env_steps if self.status else 0) - self._steps_then
        is_credible = unsent <= 2 * self.num_envs * per_env
        moved_s = self.moved_s if is_credible else 0.0
        return now_s - max(published_s, self.delivered_s, moved_s)

    def is_news(self, status: ActorStatus) -> bool:
        """Whether to pass its trouble on: the first, and each time that the loss has doubled."""
        words, dropped_steps = self.said
        is_more = status.dropped_steps >= 2 * dropped_steps
        if not status.trouble or status.trouble == words or not is_more:
            return False
        self.said = status.trouble, status.dropped_steps
        return True


@dataclass(slots=True)
class _Newcomer:
    first_s: float
    heard_s: float
    doing: str = ""


class Members:
    """The members of a run, and actors that are coming. Not thread-safe: its owner has the lock."""

    def __init__(self, seed: int, generation: int) -> None:
        self._seed = seed
        self._start = start_of(generation)
        self._present: dict[str, Member] = {}
        self._away: dict[str, Member] = {}
        self._joins: dict[int, int] = {}
        self._newcomers: dict[str, _Newcomer] = {}
        self._vanished: dict[str, _Newcomer] = {}  # their last words may come after they are gone
        self._seen: set[str] = set()
        self._dropped: dict[str, int] = {}
        self._dropped_before = 0

    @property
    def present(self) -> list[Member]:
        """Those present, by slot."""
        return sorted(self._present.values(), key=lambda member: member.slot)

    def heard(self, now_s: float) -> list[Member]:
        """Those present that were heard of lately, by slot."""
        return [member for member in self.present if now_s - member.heard_s < SILENT_S]

    def num_envs(self, now_s: float) -> int:
        """Environments that a batch is shared among: of those heard, if any were."""
        return sum(member.num_envs for member in self.heard(now_s) or self.present)

    def find(self, actor: str) -> Member | None:
        """Look up one that is present."""
        return self._present.get(actor)

    def here(self, actor: str) -> None:
        """The token of an actor, or of somebody else, is seen."""
        if len(self._seen) < MAX_SEEN:
            self._seen.add(actor)

    def gone(self, actor: str) -> None:
        """It is not seen any more."""
        self._seen.discard(actor)

    def has_token(self, actor: str) -> bool:
        """Whether the token is seen by which the end of an actor would be noticed."""
        return actor in self._seen

    def no_room_for(self, hello: Hello) -> str:
        """Why an actor with a token cannot be one more member, or ``""``."""
        if hello.actor in self._present:
            return ""
        if len(self._present) >= _MAX_MEMBERS:
            return f"the run has {_MAX_MEMBERS} actors, the most that it may have"
        num_envs = sum(member.num_envs for member in self._present.values())
        if num_envs + hello.num_envs > _MAX_ENVS:
            return (
                f"num_envs: found {hello.num_envs} beside {num_envs}, expected {_MAX_ENVS} in all"
            )
        return ""

    def join(self, hello: Hello, now_s: float) -> tuple[Member, int]:
        """Give an actor the place that it asks for, of those there may be, or the lowest free one.

        One that has a place keeps it. One that comes back after its connection was broken keeps its
        deliveries.

        Returns:
            The member, and the seed of its environments and noise: the same for the same seed of
            the run, start of the learner, place, and number of earlier holders of the place.
        """
        actor, num_envs = hello.actor, hello.num_envs
        member = self._present.get(actor)
        if member is None:
            taken = {m.slot for m in self._present.values()}
            slot = next(i for i in range(len(taken) + 1) if i not in taken)
            if 0 <= hello.slot < _MAX_MEMBERS and hello.slot not in taken:
                slot = hello.slot
            member = self._away.pop(actor, None)
            if member is None or member.num_envs != num_envs:
                member = Member(actor=actor, slot=slot, num_envs=num_envs, heard_s=now_s)
            member.slot, member.heard_s, member.delivered_s = slot, now_s, now_s
            self._present[actor] = member
            self._newcomers.pop(actor, None)
            self._joins[slot] = self._joins.get(slot, 0) + 1
        member.next_seq = hello.next_seq if hello.next_seq >= 0 else None
        key = (self._seed, self._start, member.slot, self._joins[member.slot])
        return member, int(np.random.SeedSequence(key).generate_state(1)[0])

    def leave(self, actor: str) -> Member | None:
        """Remove a member or newcomer; a member is remembered in case it comes back."""
        newcomer = self._newcomers.pop(actor, None)
        if newcomer is not None:
            self._vanished[actor] = newcomer
            _forget_oldest(self._vanished)
        member = self._present.pop(actor, None)
        if member is not None:
            self._away[actor] = member
            _forget_oldest(self._away, _MAX_AWAY)
        return member

    def begin(self) -> None:
        """New weights are out: nobody has delivered anything yet."""
        for member in (*self._present.values(), *self._away.values()):
            member.begin()

    def coming(self, actor: str, now_s: float, doing: str = "") -> None:
        """Take note of an actor that is making its environments."""
        known = self._newcomers.setdefault(actor, _Newcomer(first_s=now_s, heard_s=now_s))
        known.heard_s, known.doing = now_s, doing
        _forget_oldest(self._newcomers)

    def hear(self, member: Member, status: ActorStatus, now_s: float) -> None:
        """Remember a member's status."""
        member.hear(status, now_s)
        self._dropped[member.actor] = status.dropped_steps
        self._dropped_before += sum(_forget_oldest(self._dropped))

    def hear_newcomer(self, status: ActorStatus, now_s: float) -> bool:
        """Remember the status of an actor that is not a member, unless it was one recently.

        Tells whether it was coming, and comes no more.
        """
        if status.leaving:
            known = [each.pop(status.actor, None) for each in (self._newcomers, self._vanished)]
            return any(known)
        if status.actor not in self._away:
            self.coming(status.actor, now_s, status.doing)
        return False

    @property
    def dropped_steps(self) -> int:
        """Steps with unusable numbers, as reported by actors."""
        return self._dropped_before + sum(self._dropped.values())

    def describe_newcomers(self, now_s: float) -> str:
        """Name the actors that are coming and what the first of them does; "" without any."""
        known = {a: n for a, n in self._newcomers.items() if now_s - n.heard_s < SILENT_S}
        self._newcomers = known
        if not known:
            return ""
        actor, first = next(iter(known.items()))
        doing = first.doing or f"making its environments for {now_s - first.first_s:.0f} s"
        others = f" and {len(known) - 1} more" if len(known) > 1 else ""
        return f"{actor}{others}: {doing.removesuffix(JUST_BEGUN)}"


def _forget_oldest(known: dict[str, T], limit: int = _MAX_REMEMBERED) -> list[T]:
    """Keep a dictionary bounded; return the entries that were dropped."""
    return [known.pop(next(iter(known)))] if len(known) > limit else []
