"""Who plays: the actors present, their places, and how much of the quota each has delivered."""

from dataclasses import dataclass, field

import numpy as np

from a2s.protocol.messages import ActorStatus, Hello, Notice, Segment

_AWAY = 256


@dataclass(slots=True)
class Progress:
    """What one environment has delivered with the newest weights."""

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
        actor: Its name.
        slot: Its place.
        num_envs: Environments that it steps.
        heard_s: When it was last heard, on the learner's monotonic clock.
        progress: Of each of its environments.
        done_s: When its quota was complete, on the same clock.
        status: Its latest own account.
        said: Its latest trouble that was passed on, and the steps that it had dropped by then.
    """

    actor: str
    slot: int
    num_envs: int
    heard_s: float
    progress: list[Progress] = field(default_factory=list)
    done_s: float = 0.0
    status: ActorStatus | None = None
    said: tuple[str, int] = ("", 0)

    def __post_init__(self) -> None:
        """Begin with nothing delivered."""
        self.begin()

    def begin(self) -> None:
        """Forget what was delivered: new weights are out."""
        self.progress = [Progress() for _ in range(self.num_envs)]

    def is_news(self, status: ActorStatus) -> bool:
        """Whether to pass its trouble on: the first, and each time that twice as much is lost."""
        words, dropped_steps = self.said
        is_more = status.dropped_steps >= 2 * dropped_steps
        if not status.trouble or status.trouble == words or not is_more:
            return False
        self.said = status.trouble, status.dropped_steps
        return True

    def deliver(self, segment: Segment) -> None:
        """Count a segment that was made with the newest weights."""
        progress = self.progress[segment.env]
        progress.steps += segment.num_steps
        progress.episodes += segment.ends_episode
        progress.at_end = segment.ends_episode


class Roster:
    """The members of a run. Not thread-safe: its owner has the lock.

    Args:
        seed: Of the run.
        generation: Which start of the learner this is.
    """

    def __init__(self, seed: int, generation: int) -> None:
        self._seed = seed
        self._generation = generation
        self._members: dict[str, Member] = {}
        self._away: dict[str, Member] = {}
        self._joins: dict[int, int] = {}

    @property
    def members(self) -> list[Member]:
        """Those present, by slot."""
        return sorted(self._members.values(), key=lambda member: member.slot)

    @property
    def num_envs(self) -> int:
        """Environments of all members."""
        return sum(member.num_envs for member in self._members.values())

    def find(self, actor: str) -> Member | None:
        """Look a member up."""
        return self._members.get(actor)

    def join(self, hello: Hello, now_s: float) -> tuple[Member, int]:
        """Give an actor the place that it asks for, or else the lowest free one.

        One that has a place keeps it.

        One that comes back, because its connection was broken for a while, goes on with what it
        has delivered.

        Returns:
            The member, and the seed of its environments and noise: the same for the same seed of
            the run, generation, place, and number of those who had the place before.
        """
        actor, num_envs = hello.actor, hello.num_envs
        member = self._members.get(actor)
        if member is None:
            taken = {m.slot for m in self._members.values()}
            slot = next(i for i in range(len(taken) + 1) if i not in taken)
            if hello.slot >= 0 and hello.slot not in taken:
                slot = hello.slot
            member = self._away.pop(actor, None)
            if member is None or member.num_envs != num_envs:
                member = Member(actor=actor, slot=slot, num_envs=num_envs, heard_s=now_s)
            member.slot, member.heard_s = slot, now_s
            self._members[actor] = member
            self._joins[slot] = self._joins.get(slot, 0) + 1
        key = (self._seed, self._generation, member.slot, self._joins[member.slot])
        return member, int(np.random.SeedSequence(key).generate_state(1)[0])

    def was_here(self, actor: str) -> bool:
        """Whether it has left a while ago."""
        return actor in self._away

    def leave(self, actor: str) -> Member | None:
        """Take a member off the roster, but remember it for a while in case it comes back."""
        member = self._members.pop(actor, None)
        if member is not None:
            self._away[actor] = member
            if len(self._away) > _AWAY:
                del self._away[next(iter(self._away))]
        return member

    def begin(self) -> None:
        """New weights are out: nobody has delivered anything yet."""
        for member in (*self._members.values(), *self._away.values()):
            member.begin()
