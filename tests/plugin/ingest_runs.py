"""An ingest as tests see it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from learners import SPACES

from a2s.learner.feed import Arrival
from a2s.learner.ingest.admission import Admission
from a2s.learner.ingest.ingest import Ingest
from a2s.learner.ingest.journal import Journal, Stored
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.left_over import LeftOver
from a2s.learner.ingest.store import Quota
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.codec import encode
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.messages import Ack, Hello, Segment, Welcome

QUOTA = Quota(8, 4, 0)


class IngestRun:
    """An ingest with its files, a record of its events, and a store in memory."""

    max_policy_lag: int | None = None
    max_suggestion = 1.0
    short_steps = 0

    def __init__(
        self,
        path: Path,
        *,
        max_policy_lag: int | None = 1,
        left: Sequence[Stored] = (),
        generation: int = 2,
        episode_limit: int = 0,
        **options: Any,
    ) -> None:
        self.events: list[tuple[str, dict[str, object]]] = []
        self.metrics = LearnerMetrics()
        self.ledger = Ledger(path / "segments.log")
        self.journal = Journal(path / "journal", self.ledger.accepted_steps)
        run = RunConfig(**{"run": "test", "env": "Test-v0", "envs": 2, "n": 1, **options})
        self.ingest = Ingest(
            Admission(run, SPACES, generation, max_policy_lag, 1.001, episode_limit),
            self.ledger,
            self.metrics,
            lambda kind, **details: self.events.append((kind, details)),
            self,
            self.journal,
            LeftOver(list(left)),
        )
        self.kept: list[Segment] = []
        self.num_closed = 0
        self.disk_is_full = False
        self.is_far_behind = False

    def quota(self, num_envs: int) -> Quota:
        raise NotImplementedError

    def store(self, slot: int, segment: Segment) -> None:
        """Store a segment, unless the disk is full."""
        if self.disk_is_full:
            raise RunDirectoryError("replay: no space left on device")
        self.kept.append(segment)

    def close_batch(self) -> None:
        """What was stored so far is a batch."""
        self.num_closed = len(self.kept)

    def hold_s(self, num_batches: float) -> float:
        """Learning is behind by a batch, or for another reason."""
        return 1.5 if self.is_far_behind or num_batches >= 1 else 0.0

    def join(self, actor: str, num_envs: int = 1, slot: int = -1, next_seq: int = -1) -> Welcome:
        self.ingest.here(actor)
        hello = Hello(
            actor=actor, num_envs=num_envs, env_id="Test-v0", spaces=SPACES, slot=slot,
            next_seq=next_seq,
        )  # fmt: skip
        welcome = self.ingest.hello(hello)
        assert isinstance(welcome, Welcome)
        return welcome

    def send(self, segment: Segment) -> Ack:
        """What a segment is answered."""
        return self.ingest.segment(segment, encode(segment))

    def complete(self) -> bool:
        """Whether a batch is there."""
        return bool(self.batch())

    def batch(self) -> list[Arrival]:
        return self.ingest.next_batch(lambda _: False)
