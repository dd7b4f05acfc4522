"""Peers within one process: the semantics of a network without one."""

import logging
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from a2s.protocol.transport import Answer, OnMessage, OnPresence

logger = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")


class Exchange:
    """Where the peers of one process meet. Everything declared here is seen by all."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.answers: dict[str, tuple[InProcessBus, Callable[[bytes], bytes | None]]] = {}
        self.subscribers: list[tuple[InProcessBus, str, OnMessage]] = []
        self.presence: dict[str, InProcessBus] = {}
        self.watchers: list[tuple[InProcessBus, str, OnPresence]] = []


class InProcessBus:
    """A peer of an :class:`Exchange`; see :class:`a2s.protocol.transport.Bus`.

    Handlers run on the thread that asks or publishes.
    """

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Call the handler of ``key``; in one process there is nothing to wait for."""
        found = self._exchange.answers.get(key)
        if found is None:
            return None
        return found[1](payload)

    def answer(self, key: str, handler: Answer) -> None:
        """Answer the questions to ``key``."""
        with self._exchange.lock:
            self._exchange.answers[key] = (self, _guarded(key, handler))

    def publish(self, key: str, payload: bytes) -> None:
        """Call every subscriber."""
        with self._exchange.lock:
            found = [h for _, k, h in self._exchange.subscribers if _matches(key, k)]
        for handler in found:
            handler(payload)

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Hear what is published on ``key``."""
        with self._exchange.lock:
            self._exchange.subscribers.append((self, key, _guarded(key, handler)))

    def declare_presence(self, key: str) -> None:
        """Be seen under ``key``."""
        with self._exchange.lock:
            self._exchange.presence[key] = self
        self._tell(key, present=True)

    def withdraw_presence(self, key: str) -> None:
        """No longer be seen under ``key``."""
        with self._exchange.lock:
            gone = self._exchange.presence.pop(key, None)
        if gone is not None:
            self._tell(key, present=False)

    def watch_presence(self, key: str, handler: OnPresence) -> None:
        """Hear who comes and goes."""
        with self._exchange.lock:
            self._exchange.watchers.append((self, key, _guarded(key, handler)))
            present = [k for k in self._exchange.presence if _matches(k, key)]
        for found in present:
            handler(found, True)

    def close(self) -> None:
        """Take back everything that this peer declared."""
        hub = self._exchange
        with hub.lock:
            hub.answers = {k: v for k, v in hub.answers.items() if v[0] is not self}
            hub.subscribers = [s for s in hub.subscribers if s[0] is not self]
            hub.watchers = [w for w in hub.watchers if w[0] is not self]
            gone = [k for k, peer in hub.presence.items() if peer is self]
        for key in gone:
            self.withdraw_presence(key)

    def _tell(self, key: str, *, present: bool) -> None:
        with self._exchange.lock:
            found = [h for _, k, h in self._exchange.watchers if _matches(key, k)]
        for handler in found:
            handler(key, present)


def _matches(key: str, expression: str) -> bool:
    parts, wanted = key.split("/"), expression.split("/")
    return len(parts) == len(wanted) and all(
        want in ("*", part) for part, want in zip(parts, wanted, strict=True)
    )


def _guarded(key: str, handler: Callable[P, R]) -> Callable[P, R | None]:
    """Call a handler for one message at a time; one that raises is logged and says nothing."""
    turn = threading.RLock()

    def call(*args: P.args, **kwargs: P.kwargs) -> R | None:
        with turn:
            try:
                return handler(*args, **kwargs)
            except Exception:  # as on a network: it is no business of whoever asked or published
                logger.exception("handler failed key=%s", key)
                return None

    return call
