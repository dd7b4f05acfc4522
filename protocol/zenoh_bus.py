"""The network: a `Bus` that is a zenoh session."""

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import zenoh

from a2s.protocol.handler_log import HandlerLog
from a2s.protocol.identity import ANYBODY, Identity
from a2s.protocol.transport import Answer, AnswerEach, OnEach, OnMessage, OnPresence
from a2s.protocol.zenoh_session import connect, listen

_CLOSE_S = 2.0


class ZenohBus:
    """A peer on the network; see :class:`a2s.protocol.transport.Bus`.

    Close it before the interpreter ends: ``with contextlib.closing(ZenohBus.connect(...))``.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[object] = []
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._queriers: dict[_Manner, zenoh.Querier] = {}
        self._declaring = threading.Lock()
        self._turns: list[_Turns] = []
        self._log = HandlerLog(time.monotonic)

    @classmethod
    def listen(cls, endpoint: str, identity: Identity = ANYBODY) -> "ZenohBus":
        """Open the learner's side: a router that listens on ``endpoint``.

        Raises:
            UsageError: The endpoint is malformed or taken.
        """
        return cls(listen(endpoint, identity))

    @classmethod
    def connect(
        cls, endpoint: str, proceed: Callable[[], bool], identity: Identity = ANYBODY
    ) -> "ZenohBus":
        """Open an actor's side; once open, it finds a restarted learner again by itself.

        ``proceed`` is asked after each failed attempt of about a second; if false, give up.

        Raises:
            UsageError: The endpoint is malformed.
            RefusedError: What listens there does not let this peer in.
            UnreachableError: Nobody listens there.
        """
        return cls(connect(endpoint, proceed, identity))

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Query ``key``; an error reply, a timeout and silence are all ``None``."""
        return self.begin_asking(key, payload, timeout_s)()

    def begin_asking(
        self, key: str, payload: bytes, timeout_s: float
    ) -> Callable[[], bytes | None]:
        """Query ``key``; the replies wait in a channel."""
        return self._query(_Manner(key, timeout_s, gives_way=False), payload)

    def fetch(self, key: str, timeout_s: float) -> bytes | None:
        """Query ``key``; the reply has the low priority of its query."""
        return self._query(_Manner(key, timeout_s, gives_way=True), b"")()

    def _query(self, manner: "_Manner", payload: bytes) -> Callable[[], bytes | None]:
        """Query by a querier that is kept: one that is dropped takes its replies with it."""
        with self._declaring:
            if manner not in self._queriers:
                self._queriers[manner] = self._session.declare_querier(
                    manner.key,
                    timeout=manner.timeout_s,
                    priority=zenoh.Priority.DATA_LOW if manner.gives_way else zenoh.Priority.DATA,
                )
        replies = self._queriers[manner].get(payload=payload)
        return lambda: next((bytes(each.ok.payload) for each in replies if each.ok), None)

    def answer(self, key: str, handler: Answer) -> None:
        """Declare a queryable on ``key``."""
        self.answer_each(key, lambda _, payload: handler(payload))

    def answer_each(self, key: str, handler: AnswerEach) -> None:
        """Declare a queryable on ``key``; the handler gets the last part of the key that is asked.

        That of a question to many keys is no name.
        """

        def on_query(query: zenoh.Query) -> None:
            _answer(key, lambda payload: handler(_last(query.key_expr), payload), query, self._log)

        self._declared.append(self._session.declare_queryable(key, on_query, complete=True))

    def answer_in_turn(
        self, key: str, handler: Answer, refuse: Callable[[], bytes], at_most: int
    ) -> None:
        """Declare a queryable on ``key`` that never blocks what zenoh receives."""
        turns = _Turns(key, handler, refuse, at_most, self._log)
        self._turns.append(turns)
        self._declared.append(self._session.declare_queryable(key, turns.take, complete=True))

    def publish(self, key: str, payload: bytes) -> None:
        """Put on ``key``; dropped for a listener that cannot keep up, not to stop the others."""
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Declare a subscriber on ``key``."""
        self.subscribe_each(key, lambda _, payload: handler(payload))

    def subscribe_each(self, key: str, handler: OnEach) -> None:
        """Declare a subscriber on ``key``; the handler gets the last part of a message's key."""

        def on_sample(sample: zenoh.Sample) -> None:
            with self._log.of(key):
                handler(_last(sample.key_expr), bytes(sample.payload))

        self._declared.append(self._session.declare_subscriber(key, on_sample))

    def declare_presence(self, key: str) -> None:
        """Declare a liveliness token."""
        self._tokens[key] = self._session.liveliness().declare_token(key)

    def withdraw_presence(self, key: str) -> None:
        """Undeclare a liveliness token."""
        token = self._tokens.pop(key, None)
        if token is not None:
            token.undeclare()  # type: ignore[no-untyped-call]

    def watch_presence(self, key: str, handler: OnPresence) -> None:
        """Subscribe to liveliness tokens, those that are there already included."""

        def on_token(sample: zenoh.Sample) -> None:
            with self._log.of(key):
                handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(
            self._session.liveliness().declare_subscriber(key, on_token, history=True)
        )

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Ask for liveliness tokens."""
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def close(self) -> None:
        """Close the session: no handler is called any more.

        A peer that has become silent holds zenoh up for ten seconds, at whose end it gives up; who
        closes waits for two of them, and nobody for the rest.
        """
        for turns in self._turns:
            turns.end()
        if not self._session.is_closed():
            closing = threading.Thread(target=self._close, name="close", daemon=True)
            closing.start()
            closing.join(_CLOSE_S)

    def _close(self) -> None:
        with suppress(zenoh.ZError):  # what it has given up is closed all the same
            self._session.close()  # type: ignore[no-untyped-call]


class _Manner(NamedTuple):
    """How to ask."""

    key: str
    timeout_s: float
    gives_way: bool


class _Turns:
    """Questions that wait for a handler."""

    def __init__(
        self,
        key: str,
        handler: Answer,
        refuse: Callable[[], bytes],
        at_most: int,
        log: HandlerLog,
    ) -> None:
        self._key, self._handler, self._refuse, self._log = key, handler, refuse, log
        self._waiting: queue.Queue[zenoh.Query | None] = queue.Queue(at_most)
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=key, daemon=True)
        self._thread.start()

    def take(self, query: zenoh.Query) -> None:
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            _answer(self._key, lambda _: self._refuse(), query, self._log)

    def end(self) -> None:
        """Answer no more; the one that is being answered comes to its end."""
        self._ended = True
        with suppress(queue.Full):  # then the thread does not wait
            self._waiting.put_nowait(None)
        self._thread.join(_CLOSE_S)  # or the one who is answered reads nothing

    def _run(self) -> None:
        while (query := self._waiting.get()) is not None and not self._ended:
            _answer(self._key, self._handler, query, self._log)


def _answer(key: str, handler: Answer, query: zenoh.Query, log: HandlerLog) -> None:
    with query, log.of(key):
        answer = handler(b"" if query.payload is None else bytes(query.payload))
        if answer is not None:
            query.reply(query.key_expr, answer)


def _last(key: zenoh.KeyExpr) -> str:
    return str(key).rpartition("/")[2]
