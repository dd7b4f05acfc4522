"""The source of a run's steps, as the learner's loop sees it."""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, Self

from a2s.learner.ingest.ledger import Accounts
from a2s.learner.ingest.members import Member
from a2s.protocol.messages import RecoveryEvent, RunStatus, Segment


class Episode(NamedTuple):
    """An episode that ended; ``metrics`` are those of its environment, by name."""

    weights_version: int
    episode_return: float
    length: int
    terminated: bool
    metrics: Mapping[str, float]


class Arrival(NamedTuple):
    """Steps that were stored to be learned from, and the episode that ended with them, if any."""

    slot: int
    env: int
    seq: int
    num_steps: int
    episode: Episode | None = None

    @classmethod
    def of(cls, segment: Segment, slot: int) -> Self:
        """The counts of a segment from the actor at a place."""
        episode = None
        if segment.ends_episode and not segment.short:
            episode = Episode(
                weights_version=segment.weights_version,
                episode_return=segment.episode_return,
                length=segment.episode_length,
                terminated=segment.terminated,
                metrics={metric.name: metric.value for metric in segment.metrics},
            )
        return cls(slot, segment.env, segment.seq, segment.num_steps, episode)


def in_order(arrivals: Iterable[Arrival]) -> list[Arrival]:
    """Sort by slot, environment and number: so a batch does not depend on the order of arrival."""
    return sorted(arrivals, key=lambda arrival: arrival[:3])


class Attendance(NamedTuple):
    """The actors present, by slot, and the fate of all segments so far."""

    members: tuple[Member, ...] = ()
    pending_steps: int = 0
    accounts: Accounts = Accounts()
    dropped_steps: int = 0


class Feed:
    """A feed without actors; `ingest.server.Server` is the one with them."""

    def tell(self, status: Callable[[], RunStatus]) -> None:
        """Answer requests for the status from now on."""

    def open(self) -> None:
        """Have actors come in."""

    def next_version(self, version: int) -> int:
        """The version after this one."""
        return version + 1

    def publish(self, make_graph: Callable[[int], bytes], version: int, epoch: int) -> None:
        """Give the present networks to the actors under this version."""

    def announce_recovery(self, event: RecoveryEvent) -> None:
        """Announce to all listeners that the learner went back."""

    def next_batch(self, proceed: Callable[[str], bool]) -> list[Arrival]:
        """Wait until the next batch is stored.

        ``proceed`` is given what the batch waits for about once a second; when it returns false,
        the wait ends.

        Returns:
            Its arrivals, in an order that does not depend on the order of arrival; empty if the
            wait was ended.

        Raises:
            A2SError: Steps cannot be stored, or the replay cannot be reached.
        """
        raise NotImplementedError

    def attendance(self) -> Attendance:
        """Take a look at the actors."""
        return Attendance()

    def stop(self) -> None:
        """Accept no more steps."""

    def take(self) -> list[Arrival]:
        """Take the steps that came too late to be a batch."""
        return []

    def close(self) -> None:
        """Close connections and files."""
