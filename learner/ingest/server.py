"""The learner's side of the protocol: every key of the run and what answers it."""

from collections.abc import Callable

from a2s.learner.ingest.ingest import Gather
from a2s.protocol.codec import decode, encode, refuse_major_1
from a2s.protocol.errors import MalformedMessageError, OversizeMessageError, SchemaMismatchError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import ActorStatus, Hello, RecoveryEvent, RunStatus, Segment
from a2s.protocol.transport import Bus


class Service:
    """Connects a bus to the gathering; :meth:`open` makes the learner visible.

    Args:
        bus: The connection.
        keys: Of the run.
        gather: Judges hellos and segments.
        status: Makes a status on request.
    """

    def __init__(
        self, bus: Bus, keys: Keys, gather: Gather, status: Callable[[], RunStatus]
    ) -> None:
        self._bus = bus
        self._keys = keys
        self._gather = gather
        self._status = status

    def open(self) -> None:
        """Declare everything; the presence comes last, when all else can be answered."""
        bus, keys = self._bus, self._keys
        bus.answer(keys.hello, self._on_hello)
        bus.answer(keys.hello_of_major_1, lambda _: self._on_hello_of_major_1())
        bus.answer(keys.segment, self._on_segment)
        bus.answer(keys.status, lambda _: encode(self._status()))
        bus.subscribe(keys.actor_status(), self._on_actor_status)
        bus.watch_presence(keys.live_actor(), self._on_presence)
        bus.declare_presence(keys.live_learner)

    def announce_recovery(self, event: RecoveryEvent) -> None:
        """Tell everybody who listens that the learner went back."""
        self._bus.publish(self._keys.recovery, encode(event))

    def _on_hello(self, payload: bytes) -> bytes:
        try:
            hello = decode(payload, Hello)
        except MalformedMessageError as error:
            return encode(self._gather.refuse("hello", _cause(error), str(error)))
        return encode(self._gather.hello(hello))

    def _on_hello_of_major_1(self) -> bytes:
        self._gather.refuse("hello", "schema", "an actor of protocol 1")
        return refuse_major_1()

    def _on_segment(self, payload: bytes) -> bytes:
        try:
            segment = decode(payload, Segment)
        except MalformedMessageError as error:
            return encode(self._gather.refuse_segment(_cause(error), str(error)))
        return encode(self._gather.segment(segment))

    def _on_actor_status(self, payload: bytes) -> None:
        try:
            status = decode(payload, ActorStatus)
        except MalformedMessageError as error:
            self._gather.refuse("status", _cause(error), str(error))
            return
        self._gather.status(status)

    def _on_presence(self, key: str, present: bool) -> None:
        if not present:
            self._gather.gone(key.rsplit("/", 1)[-1])


def _cause(error: MalformedMessageError) -> str:
    """Name the kind of defect, for a label with few values."""
    if isinstance(error, OversizeMessageError):
        return "oversize"
    return "schema" if isinstance(error, SchemaMismatchError) else "malformed"
