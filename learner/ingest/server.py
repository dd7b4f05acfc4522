"""The learner's side of the protocol: every key of the run and its answers."""

import hashlib
import threading
from collections.abc import Callable

from a2s.learner.feed import Arrival, Attendance, Feed
from a2s.learner.ingest.evaluations import Evaluations
from a2s.learner.ingest.ingest import Ingest
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.codec import decode, encode, refuse_major_1
from a2s.protocol.errors import MalformedMessageError, OversizeMessageError, SchemaMismatchError
from a2s.protocol.evaluation_messages import EvaluationRequest, EvaluationResult
from a2s.protocol.keys import Keys
from a2s.protocol.messages import (
    ActorStatus,
    Hello,
    Notice,
    RecoveryEvent,
    RunStatus,
    Segment,
    Weights,
)
from a2s.protocol.transport import Bus

_MAX_WAITING = 4096  # for weights: as many as a run may have members


class Server(Feed):
    """Connects actors with the ingest, and gives them weights.

    The learner can be asked for its status after :meth:`tell`; actors see it with :meth:`open`.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        generation: int,
        ingest: Ingest,
        evaluations: Evaluations,
        metrics: LearnerMetrics,
    ) -> None:
        self._bus, self._keys, self._generation = bus, keys, generation
        self._ingest, self._metrics = ingest, metrics
        self._evaluations = evaluations
        self._lock = threading.Lock()
        self._newest = b"", b""  # notice and weights
        self._status: Callable[[], RunStatus] | None = None

    def tell(self, status: Callable[[], RunStatus]) -> None:
        """Answer requests for the status."""
        self._status = status
        self._bus.answer(self._keys.status, lambda _: encode(status()))

    def open(self) -> None:
        """Declare everything else; the presence comes last, when all can be answered."""
        bus, keys = self._bus, self._keys
        bus.watch_presence(keys.live_actor(), self._on_presence)  # who joins has been seen
        bus.answer(keys.notice, lambda _: self._give_newest()[0])
        # Who reads nothing holds up those who wait for weights, until its link is closed.
        bus.answer_in_turn(keys.weights, lambda _: self._give_newest()[1], bytes, _MAX_WAITING)
        bus.answer(keys.hello, self._on_hello)
        bus.answer_each(keys.hello_of(), lambda name, payload: self._on_hello(payload, name))
        bus.answer(keys.hello_of_major_1, lambda _: self._on_hello_of_major_1())
        bus.answer(keys.segment, self._on_segment)
        bus.answer_each(keys.segment_of(), lambda name, payload: self._on_segment(payload, name))
        bus.answer(keys.evaluation_task, self._on_evaluation_request)
        bus.answer(keys.evaluation_result, self._on_evaluation_result)
        bus.subscribe_each(keys.actor_status(), self._on_actor_status)
        bus.declare_presence(keys.live_learner)

    def publish(self, make_graph: Callable[[int], bytes], version: int, epoch: int) -> None:
        """Announce weights with the quota to be played by them, and keep them for requests."""
        graph = make_graph(version)
        num_envs, quota = self._ingest.quota(version, epoch)
        notice = Notice(
            generation=self._generation,
            epoch=epoch,
            version=version,
            quota_steps=quota.steps,
            quota_episodes=quota.episodes,
            num_bytes=len(graph),
            sha256=hashlib.sha256(graph).hexdigest(),
        )
        newest = encode(notice), encode(Weights(notice=notice, graph=graph))
        self._ingest.begin(notice, quota, num_envs)  # before anybody can play by them
        with self._lock:
            self._newest = newest
        self._bus.publish(self._keys.notice, newest[0])
        self._metrics.weights_bytes.set(len(graph))

    def announce_recovery(self, event: RecoveryEvent) -> None:
        """Announce to all listeners that the learner went back."""
        self._bus.publish(self._keys.recovery, encode(event))

    def next_batch(self, proceed: Callable[[str], bool]) -> list[Arrival]:
        """Wait until the next batch is stored."""
        return self._ingest.next_batch(proceed)

    def stop(self) -> None:
        """Stop listening; if the run has ended, actors are told."""
        if self._status is not None and (told := self._status()).ended:
            self._bus.publish(self._keys.status, encode(told))
        self._bus.close()

    def take(self) -> list[Arrival]:
        """Take the segments that came too late for a batch."""
        return self._ingest.take()

    def attendance(self) -> Attendance:
        """Give the actors present."""
        return self._ingest.attendance()

    def close(self) -> None:
        """End the connection, then close ledger and journal."""
        self._bus.close()
        self._ingest.close()

    def _give_newest(self) -> tuple[bytes, bytes]:
        with self._lock:
            return self._newest

    def _on_hello(self, payload: bytes, name: str | None = None) -> bytes | None:
        try:
            hello = decode(payload, Hello)
            _require_own(hello.actor, name)
        except MalformedMessageError as error:
            return encode(self._ingest.refuse("hello", _cause(error), str(error)))
        answer = self._ingest.hello(hello)
        return None if answer is None else encode(answer)

    def _on_hello_of_major_1(self) -> bytes:
        self._ingest.refuse("hello", "schema", "an actor of protocol 1")
        return refuse_major_1()

    def _on_segment(self, payload: bytes, name: str | None = None) -> bytes:
        try:
            segment = decode(payload, Segment)
            _require_own(segment.actor, name)
        except MalformedMessageError as error:
            return encode(self._ingest.refuse_segment(_cause(error), str(error)))
        return encode(self._ingest.segment(segment, payload))

    def _on_actor_status(self, name: str, payload: bytes) -> None:
        try:
            status = decode(payload, ActorStatus)
            _require_own(status.actor, name)
        except MalformedMessageError as error:
            self._ingest.refuse("status", _cause(error), str(error))
            return
        self._ingest.status(status)

    def _on_evaluation_request(self, payload: bytes) -> bytes:
        try:
            task = self._evaluations.ask(decode(payload, EvaluationRequest))
        except MalformedMessageError as error:
            return encode(self._ingest.refuse("evaluation", _cause(error), str(error)))
        return b"" if task is None else encode(task)

    def _on_evaluation_result(self, payload: bytes) -> bytes:
        try:
            self._evaluations.answer(decode(payload, EvaluationResult))
        except MalformedMessageError as error:
            return encode(self._ingest.refuse("evaluation", _cause(error), str(error)))
        return b""

    def _on_presence(self, key: str, present: bool) -> None:
        name = key.rsplit("/", 1)[-1]
        if present:
            self._ingest.here(name)
            self._evaluations.here(name)
        else:
            self._ingest.gone(name)
            self._evaluations.gone(name)


def _require_own(actor: str, name: str | None) -> None:
    """Refuse an actor that speaks for another: rules of access are about keys (docs/security.md).

    Raises:
        MalformedMessageError: It does.
    """
    if name not in (None, actor):
        raise MalformedMessageError(f"actor: found {actor!r} under the key of {name!r}")


def _cause(error: MalformedMessageError) -> str:
    """Name the kind of defect, for a label with few values."""
    if isinstance(error, OversizeMessageError):
        return "oversize"
    return "schema" if isinstance(error, SchemaMismatchError) else "malformed"
