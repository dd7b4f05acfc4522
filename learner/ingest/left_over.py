"""What an earlier learner had accepted and not learned from: part of this one's first batch."""

from dataclasses import dataclass, field

from a2s.learner.feed import Arrival
from a2s.learner.ingest.journal import Begun, Stored
from a2s.learner.ingest.members import Member
from a2s.learner.ingest.store import Quota
from a2s.protocol.messages import Notice


@dataclass(slots=True)
class LeftOver:
    """Segments that are in the store already, all of one epoch, and the weights of then."""

    stored: list[Stored] = field(default_factory=list)
    begun: Begun | None = None

    @property
    def arrivals(self) -> list[Arrival]:
        """The segments, as a batch has them."""
        return [Arrival.of(segment, slot) for slot, segment in self.stored]

    @property
    def epoch(self) -> int:
        """Of all of them."""
        return self.stored[0].segment.epoch if self.stored else 0

    def quota(self, version: int, epoch: int) -> Quota | None:
        """The quota that weights had before, if they were out."""
        begun = self.begun
        if begun is None or (begun.version, begun.epoch) != (version, epoch):
            return None
        return begun.quota

    def deliver(self, member: Member, notice: Notice) -> None:
        """Count for a member what its place has delivered of this version before."""
        for slot, segment in self.stored:
            is_its = slot == member.slot and segment.env < member.num_envs
            made_by = segment.epoch, segment.weights_version
            if is_its and made_by == (notice.epoch, notice.version):
                member.deliver(segment)
