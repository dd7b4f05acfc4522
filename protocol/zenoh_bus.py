"""The network: one zenoh session with explicit links only, no discovery, no shared memory.

The learner's session is the router (docs/adr/0003), so no other process is needed.
"""

import json
import logging
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Literal

import zenoh

from a2s.protocol.errors import A2SError, UnreachableError, UsageError
from a2s.protocol.transport import Answer, OnMessage, OnPresence

logger = logging.getLogger(__name__)

_PATIENCE_S = 10.0

_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/[^/?#]+:(?P<port>\d{1,5})|unixsock-stream/.+")

_SETTINGS = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,  # otherwise opening takes half a second
    # Queries over shared memory can be lost (eclipse-zenoh/zenoh #2628).
    "transport/shared_memory/enabled": False,
    "transport/unicast/max_sessions": 4096,
    "transport/unicast/accept_pending": 1024,
    # A peer that hangs is noticed after this; shorter gives false alarms on loaded hosts.
    "transport/link/tx/lease": 10_000,
    "transport/link/tx/keep_alive": 4,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 20_000_000,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
    "transport/link/rx/buffer_size": 1 << 20,
    "transport/link/rx/max_message_size": 512 << 20,
}


def _config(mode: Literal["router", "client"], settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in {"mode": mode, **_SETTINGS, **settings}.items():
        config.insert_json5(path, json.dumps(value))
    return config


class ZenohBus:
    """A peer on the network; see :class:`a2s.protocol.transport.Bus`.

    Close it before the interpreter ends: ``with contextlib.closing(ZenohBus.connect(...))``.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[object] = []
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._turns: list[_Turns] = []

    @classmethod
    def listen(cls, endpoint: str) -> "ZenohBus":
        """Open the learner's side: a router that listens on ``endpoint``.

        Raises:
            UsageError: The endpoint is malformed or taken.
        """
        check_endpoint(endpoint)
        try:
            return cls(zenoh.open(_config("router", {"listen/endpoints": [endpoint]})))
        except zenoh.ZError as error:
            raise UsageError(
                f"cannot listen on {endpoint}: {_reason(error)}; "
                "choose another endpoint with --listen tcp/HOST:PORT"
            ) from None

    @classmethod
    def connect(cls, endpoint: str, proceed: Callable[[], bool]) -> "ZenohBus":
        """Open an actor's side; once open, it finds a restarted learner again by itself.

        ``proceed`` is asked after each failed attempt of about a second; if false, give up.

        Raises:
            UsageError: The endpoint is malformed.
            UnreachableError: Nobody listens there.
        """
        check_endpoint(endpoint)
        retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
        config = _config(
            "client",
            {"connect/endpoints": [endpoint], "connect/timeout_ms": 1000, "connect/retry": retry},
        )
        begin = said = time.monotonic()
        while True:
            try:
                return cls(zenoh.open(config))
            except zenoh.ZError:
                now = time.monotonic()
                nobody = f"no learner at {endpoint} after {now - begin:.0f} s"
                if not proceed():
                    raise UnreachableError(
                        f"{nobody}; start `a2s learner`, or name its endpoint with --connect"
                    ) from None
                if now - said >= _PATIENCE_S:
                    said = now
                    logger.warning("%s; still trying, start `a2s learner` there", nobody)

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Query ``key``; an error reply, a timeout and silence are all ``None``."""
        querier = self._queriers.get((key, timeout_s))
        if querier is None:
            querier = self._session.declare_querier(key, timeout=timeout_s)
            self._queriers[key, timeout_s] = querier
        for reply in querier.get(payload=payload):
            if reply.ok is not None:
                return bytes(reply.ok.payload)
        return None

    def answer(self, key: str, handler: Answer) -> None:
        """Declare a queryable on ``key``."""

        def on_query(query: zenoh.Query) -> None:
            _answer(key, handler, query)

        self._declared.append(self._session.declare_queryable(key, on_query, complete=True))

    def answer_in_turn(
        self, key: str, handler: Answer, refuse: Callable[[], bytes], at_most: int
    ) -> None:
        """Declare a queryable on ``key`` that never blocks what zenoh receives."""
        turns = _Turns(key, handler, refuse, at_most)
        self._turns.append(turns)
        self._declared.append(self._session.declare_queryable(key, turns.take, complete=True))

    def publish(self, key: str, payload: bytes) -> None:
        """Put on ``key``; dropped for a listener that cannot keep up, not to stop the others."""
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Declare a subscriber on ``key``."""

        def on_sample(sample: zenoh.Sample) -> None:
            with _logged(key):
                handler(bytes(sample.payload))

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
            with _logged(key):
                handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(
            self._session.liveliness().declare_subscriber(key, on_token, history=True)
        )

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Ask for liveliness tokens."""
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def close(self) -> None:
        """Close the session."""
        for turns in self._turns:
            turns.end()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]


class _Turns:
    """Questions that wait for a handler."""

    def __init__(
        self, key: str, handler: Answer, refuse: Callable[[], bytes], at_most: int
    ) -> None:
        self._key, self._handler, self._refuse = key, handler, refuse
        self._waiting: queue.Queue[zenoh.Query | None] = queue.Queue(at_most)
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=key)
        self._thread.start()

    def take(self, query: zenoh.Query) -> None:
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            _answer(self._key, lambda _: self._refuse(), query)

    def end(self) -> None:
        """Answer no more; the one that is being answered comes to its end."""
        self._ended = True
        with suppress(queue.Full):  # then the thread does not wait
            self._waiting.put_nowait(None)
        self._thread.join()

    def _run(self) -> None:
        while (query := self._waiting.get()) is not None and not self._ended:
            _answer(self._key, self._handler, query)


def _answer(key: str, handler: Answer, query: zenoh.Query) -> None:
    with query, _logged(key):
        answer = handler(b"" if query.payload is None else bytes(query.payload))
        if answer is not None:
            query.reply(query.key_expr, answer)


@contextmanager
def _logged(key: str) -> Iterator[None]:
    try:
        yield
    except A2SError as error:
        logger.error("%s", error)  # noqa: TRY400  # its one line says all
    except Exception:  # zenoh's thread would print it and go on; it belongs in our log
        logger.exception("handler failed key=%s", key)


def check_endpoint(endpoint: str) -> None:
    """Raise UsageError unless the endpoint is of the form PROTOCOL/HOST:PORT."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or not 0 < int(found["port"] or 1) < 1 << 16:
        raise UsageError(
            f"endpoint: found {endpoint!r}, expected PROTOCOL/HOST:PORT, "
            "for example tcp/127.0.0.1:7447"
        )


def _reason(error: Exception) -> str:
    """Find the operating system's words in zenoh's error, for example "Address in use"."""
    found = re.search(r"\[[^\[]*?: ([^\[\]:]+) \(os error", str(error))
    return found[1] if found else str(error).split("\n")[0].split(" at /")[0]
