"""A feed of the journal: the batches that were taken since a checkpoint, once more."""

import logging
from collections.abc import Callable, Sequence

from a2s.learner.feed import Arrival, Feed, in_order
from a2s.learner.ingest.journal import (
    Begun,
    Journal,
    Place,
    Record,
    Stored,
    Taken,
    num_steps,
    read,
    require_all,
)
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.left_over import LeftOver
from a2s.learner.ingest.store import Store

logger = logging.getLogger(__name__)


def read_again(journal: Journal, place: Place, ledger: Ledger) -> list[Record]:
    """Read what was accepted since a place; what the ledger has lost is written into it.

    Raises:
        RunDirectoryError: The journal is damaged, or the ledger knows more than it.
    """
    records, size = read(journal.folder, place)
    stored = (record.segment for record in records if isinstance(record, Stored))
    unknown = [segment for segment in stored if not ledger.knows(segment.actor, segment.seq)]
    expected = place.accepted_steps + num_steps(records)
    lost = ledger.accepted_steps + sum(segment.num_steps for segment in unknown) - expected
    require_all(journal.folder, lost)
    journal.cut(size)
    for segment in unknown:
        ledger.record(segment.actor, segment.seq, "accepted", segment.num_steps)
    if lost < 0:
        logger.warning("segments.log: %d steps fewer than were learned from; going on", -lost)
    return records


class JournalFeed(Feed):
    """Stores the segments of the journal and gives their batches, in the order of then.

    Attributes:
        left_over: What is in the store and was not taken, once there is no batch any more.
    """

    def __init__(self, journal: Journal, records: Sequence[Record], store: Store) -> None:
        self._journal, self._records, self._store = journal, iter(records), store
        self.left_over = LeftOver()

    def publish(self, make_graph: Callable[[int], bytes], version: int, epoch: int) -> None:
        """Nobody plays, but whoever makes the graph notes its version, and it has a quota."""
        make_graph(version)
        begun = self.left_over.begun
        if begun is not None:  # a kill may have come before it was written down
            quota = self._store.quota(begun.num_envs)
            self.left_over.begun = Begun(version, epoch, begun.num_envs, quota)

    def next_batch(self, proceed: Callable[[str], bool]) -> list[Arrival]:
        """Store up to the end of the next batch; empty if there is none, or if that is ended."""
        if not proceed(""):
            return []
        for record in self._records:
            match record:
                case Stored(slot, segment):
                    self._store.store(slot, segment)
                    self.left_over.stored.append(record)
                case Begun(_, epoch, num_envs):
                    self.left_over.begun = record
                    self._store.quota(num_envs)
                    if any(segment.epoch != epoch for _, segment in self.left_over.stored):
                        self._take()
                case Taken(end):
                    self._journal.place = end
                    return self._take()
        return []

    def _take(self) -> list[Arrival]:
        self._store.close_batch()
        arrivals = self.left_over.arrivals
        self.left_over.stored.clear()
        return in_order(arrivals)
