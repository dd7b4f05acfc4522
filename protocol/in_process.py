"""Peers within one process: a network's semantics without a network."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from a2s.protocol.transport import Answer, AnswerEach, OnEach, OnMessage, OnPresence

logger = logging.getLogger(__name__)

Declared = tuple["InProcessBus", str, Callable[..., Any]]  # by whom, on which key, its handler


class Exchange:
    """Where the peers of one process meet."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.answers: dict[str, tuple[InProcessBus, Answer]] = {}
        self.answers_each: dict[str, tuple[InProcessBus, AnswerEach]] = {}
        self.subscribers: list[Declared] = []
        self.presence: dict[str, InProcessBus] = {}
        self.watchers: list[Declared] = []


class InProcessBus:
    """A peer of an :class:`Exchange`; see :class:`a2s.protocol.transport.Bus`.

    Handlers run on the thread that asks or publishes.
    """

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Call the handler of ``key``."""
        found = self._exchange.answers.get(key)
        if found is not None:
            return found[1](payload)
        where, _, name = key.rpartition("/")
        each = self._exchange.answers_each.get(f"{where}/*")
        return None if each is None else each[1](name, payload)

    def begin_asking(
        self, key: str, payload: bytes, timeout_s: float
    ) -> Callable[[], bytes | None]:
        """Call the handler of ``key``, and keep its answer."""
        answer = self.ask(key, payload, timeout_s)
        return lambda: answer

    def fetch(self, key: str, timeout_s: float) -> bytes | None:
        """Call the handler of ``key``."""
        return self.ask(key, b"", timeout_s)

    def answer(self, key: str, handler: Answer) -> None:
        """Answer the questions to ``key``."""
        with self._exchange.lock:
            self._exchange.answers[key] = (self, _guarded(key, handler))

    def answer_in_turn(
        self, key: str, handler: Answer, refuse: Callable[[], bytes], at_most: int
    ) -> None:
        """Call the handler for one who asks, while so many wait."""
        places, answer = threading.Semaphore(1 + at_most), _guarded(key, handler)

        def enter(payload: bytes) -> bytes | None:
            if not places.acquire(blocking=False):
                return refuse()
            try:
                found: bytes | None = answer(payload)
            finally:
                places.release()
            return found

        with self._exchange.lock:
            self._exchange.answers[key] = (self, enter)

    def answer_each(self, key: str, handler: AnswerEach) -> None:
        """Answer the questions to all keys of this form."""
        with self._exchange.lock:
            self._exchange.answers_each[key] = (self, _guarded(key, handler))

    def publish(self, key: str, payload: bytes) -> None:
        """Call every subscriber."""
        self._call(self._exchange.subscribers, key, key, payload)

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Hear what is published on ``key``."""
        with self._exchange.lock:
            call = _guarded(key, lambda _, payload: handler(payload))
            self._exchange.subscribers.append((self, key, call))

    def subscribe_each(self, key: str, handler: OnEach) -> None:
        """Hear what is published on all keys of this form."""
        with self._exchange.lock:
            call = _guarded(key, lambda where, payload: handler(where.rpartition("/")[2], payload))
            self._exchange.subscribers.append((self, key, call))

    def declare_presence(self, key: str) -> None:
        """Be seen under ``key``."""
        with self._exchange.lock:
            self._exchange.presence[key] = self
        self._call(self._exchange.watchers, key, key, True)

    def withdraw_presence(self, key: str) -> None:
        """No longer be seen under ``key``."""
        with self._exchange.lock:
            gone = self._exchange.presence.pop(key, None)
        if gone is not None:
            self._call(self._exchange.watchers, key, key, False)

    def watch_presence(self, key: str, handler: OnPresence) -> None:
        """Hear who comes and goes."""
        with self._exchange.lock:
            self._exchange.watchers.append((self, key, _guarded(key, handler)))
            present = [k for k in self._exchange.presence if _matches(k, key)]
        for found in present:
            handler(found, True)

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Look who is there."""
        with self._exchange.lock:
            return [each for each in self._exchange.presence if _matches(each, key)]

    def close(self) -> None:
        """Take back everything that this peer declared."""
        hub = self._exchange
        with hub.lock:
            hub.answers = {k: v for k, v in hub.answers.items() if v[0] is not self}
            hub.answers_each = {k: v for k, v in hub.answers_each.items() if v[0] is not self}
            hub.subscribers = [s for s in hub.subscribers if s[0] is not self]
            hub.watchers = [w for w in hub.watchers if w[0] is not self]
            gone = [k for k, peer in hub.presence.items() if peer is self]
        for key in gone:
            self.withdraw_presence(key)

    def _call(self, declared: list[Declared], key: str, *args: bytes | str | bool) -> None:
        with self._exchange.lock:
            found = [handler for _, where, handler in declared if _matches(key, where)]
        for handler in found:
            handler(*args)


def _matches(key: str, expression: str) -> bool:
    parts, wanted = key.split("/"), expression.split("/")
    return len(parts) == len(wanted) and all(
        want in ("*", part) for part, want in zip(parts, wanted, strict=True)
    )


def _guarded(key: str, handler: Callable[..., Any]) -> Callable[..., Any]:
    """Call a handler for one message at a time; if it raises, log that and return ``None``."""
    turn = threading.RLock()

    def call(*args: bytes | str | bool) -> Any:
        with turn:
            try:
                return handler(*args)
            except Exception:  # as on a network, whoever asked or published does not see it
                logger.exception("handler failed key=%s", key)
                return None

    return call
