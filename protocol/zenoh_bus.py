"""The network: one zenoh session with explicit links only, no discovery, no shared memory.

The learner's session is the router (docs/adr/0003), so no other process is needed.
"""

import json
import logging
import queue
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal, NamedTuple

import zenoh

from a2s.protocol import refusal
from a2s.protocol.endpoint import check_endpoint
from a2s.protocol.errors import RefusedError, UnreachableError, UsageError
from a2s.protocol.handler_log import HandlerLog
from a2s.protocol.identity import ANYBODY, Identity, is_local
from a2s.protocol.transport import Answer, AnswerEach, OnEach, OnMessage, OnPresence

logger = logging.getLogger(__name__)

_PATIENCE_S = 10.0
_REFUSED_WITHIN_S = 1.0
_TRIES, _AGAIN_S = 2, 0.5
_OPEN_MS = 2000
_CLOSE_S = 2.0
_START = "start `a2s learner` (--resume goes on with a run)"

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
# What the kernel has taken to send, nothing can overtake: on a way that carries 60 kB/s it would
# take up to 4 MB, and an answer would come a minute later (docs/adr/0036).
_OVER_NETWORKS = {f"transport/link/{kind}/so_sndbuf": 64 << 10 for kind in ("tcp", "tls")}


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
        check_endpoint(endpoint)
        settings = {"listen/endpoints": [endpoint], **identity.settings}
        if not is_local(endpoint):
            settings |= _OVER_NETWORKS
        try:
            return cls(zenoh.open(_config("router", settings)))
        except zenoh.ZError as error:
            raise UsageError(
                f"cannot listen on {endpoint}: {_reason(error)}; "
                "choose another endpoint with --listen tcp/HOST:PORT"
            ) from None

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
        check_endpoint(endpoint)
        retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
        settings = {
            "connect/endpoints": [endpoint], "connect/retry": retry, **identity.settings
        }  # fmt: skip
        config = _config("client", {**settings, "connect/timeout_ms": 1000})
        begin = said = time.monotonic()
        while True:
            try:
                return cls(zenoh.open(config))
            except zenoh.ZError:
                is_awaited = refusal.is_awaited(endpoint)
                if is_awaited and (session := _try(endpoint, identity, settings)) is not None:
                    return cls(session)
                now = time.monotonic()
                goes_on = proceed()
                if goes_on and now - said < _PATIENCE_S:
                    continue
                nobody = _nobody(endpoint, now - begin, identity, is_awaited=is_awaited)
                if not goes_on:
                    raise UnreachableError(
                        f"{nobody}; {_START}, or name its endpoint with --connect"
                    ) from None
                said = now
                logger.warning("%s; still trying, %s there", nobody, _START)

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


def _nobody(endpoint: str, waited_s: float, identity: Identity, *, is_awaited: bool) -> str:
    """Say who is missing, with what is known of the reason."""
    found = f"no learner at {endpoint} after {waited_s:.0f} s"
    if is_awaited:
        found += ", though something listens there: it may hang"
        return found if identity.folder is None else f"{found}, or be without --tls"
    return found if refusal.has_address(endpoint) else f"{found}: its host has no address here"


def _try(endpoint: str, identity: Identity, settings: dict[str, Any]) -> zenoh.Session | None:
    """Try, where something listens: zenoh fails at once if it is not let in.

    ``None``: what listens does not answer.

    Raises:
        RefusedError: It does, with what is known of the reason.
    """
    for _ in range(_TRIES):
        begin = time.monotonic()
        try:
            return zenoh.open(
                _config("client", {**settings, "transport/unicast/open_timeout": _OPEN_MS})
            )
        except zenoh.ZError:
            is_refused = time.monotonic() - begin < _REFUSED_WITHIN_S
        if not is_refused:
            break
        time.sleep(_AGAIN_S)
        if not refusal.is_awaited(endpoint):  # a learner that ends does not let anybody in, either
            return None
    if found := refusal.why(endpoint, identity):
        raise RefusedError(f"{endpoint}: {found}")
    if is_refused and identity.folder is None:
        who = f"user {identity.name!r} with this password" if identity.name else "this peer"
        expected = (
            "a learner with the same line in its --password-file; or give none if it wants none"
            if identity.name
            else "a user; name a file with its line with --password-file, or give A2S_PASSWORD"
        )
        raise RefusedError(
            f"{endpoint}: what listens there does not let {who} in; expected {expected}"
        )
    return None


def _last(key: zenoh.KeyExpr) -> str:
    return str(key).rpartition("/")[2]


def _reason(error: Exception) -> str:
    """Find the operating system's words in zenoh's error, for example "Address in use"."""
    found = re.search(r"\[[^\[]*?: ([^\[\]:]+) \(os error", str(error))
    return found[1] if found else str(error).split("\n")[0].split(" at /")[0]
