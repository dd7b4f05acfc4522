"""A bounded queue that keeps every segment until the learner has answered it."""

import contextlib
import random
import threading
from collections import deque
from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

from a2s.actors.metrics import ActorMetrics
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.messages import Ack, Segment
from a2s.protocol.transport import Bus

_ASK_TIMEOUT_S = 3.0
_BACK_OFF_S = (0.05, 1.0)
_MAX_BYTES = 256 << 20


class _Waiting(NamedTuple):
    payload: bytes
    steps: int


class Outbox:
    """Sends segments in order, one at a time, each until it is answered.

    At least once on the wire: a segment without an answer is sent again, the same bytes. When the
    outbox is full :meth:`put` blocks, so that an absent learner holds the actor back instead of
    filling its memory. ``capacity_steps`` may wait, in at most 256 MiB; at least one segment always
    fits. On the sender's thread, ``on_ack`` gets every answer, and ``on_unknown`` is called when
    the learner does not know this actor.

    Attributes:
        steps: Steps that wait for an answer.
        answered: Segments that were answered.
    """

    def __init__(
        self,
        bus: Bus,
        key: str,
        capacity_steps: int,
        on_ack: Callable[[Ack], None],
        on_unknown: Callable[[], None],
        metrics: ActorMetrics,
    ) -> None:
        self._bus, self._key = bus, key
        self._made_for_steps = self._capacity_steps = capacity_steps
        self._on_ack, self._on_unknown = on_ack, on_unknown
        self._metrics = metrics
        self._waiting: deque[_Waiting] = deque()
        self.steps = self._bytes = 0
        self._random = random.Random()  # the global one is the environments'
        self.answered = 0
        self._draining = self._closing = self._held_back = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._send_all, name="outbox")
        self._thread.start()
        metrics.outbox_capacity.set(capacity_steps)
        metrics.outbox.set(0)

    def narrow(self, steps: int) -> None:
        """Lower the limit of waiting steps, never above the capacity it was made with."""
        with self._changed:
            self._capacity_steps = min(self._made_for_steps, steps)
            self._changed.notify_all()
        self._metrics.outbox_capacity.set(self._capacity_steps)

    def put(self, segment: Segment, timeout_s: float) -> bool:
        """Hand over a segment; tell whether it was taken.

        Blocks for at most ``timeout_s`` seconds while the outbox is full.
        """
        item = _Waiting(encode(segment), segment.num_steps)
        with self._changed:
            if not self._changed.wait_for(lambda: self._fits(item), timeout=timeout_s):
                return False
            self._waiting.append(item)
            self._count(item, 1)
            self._changed.notify_all()
        return True

    def _fits(self, item: _Waiting) -> bool:
        if not self._waiting:
            return True
        fits = self.steps + item.steps <= self._capacity_steps and not self._held_back
        return fits and self._bytes + len(item.payload) <= _MAX_BYTES

    def close(self, timeout_s: float) -> int:
        """Stop taking, send what waits, and end the thread; give the count of unanswered segments.

        It takes ``timeout_s`` seconds and one request at most. A learner that does not answer is
        not asked again: usually its run is over.
        """
        with self._changed:
            self._draining = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        self._closing = True
        self._thread.join(_ASK_TIMEOUT_S)
        left = sum(item.steps for item in self._waiting)
        if left:
            self._metrics.dropped.labels("shutdown").inc(left)
        return len(self._waiting)

    def _send_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._draining or bool(self._waiting))
                if not self._waiting:
                    return
                item = self._waiting[0]
            ack = self._send(item)
            if ack is None:
                return
            with self._changed:
                self._waiting.popleft()
                self._count(item, -1)
                self.answered += 1
                self._held_back = ack.wait_s > 0
                self._changed.notify_all()
            self._on_ack(ack)
            self._pause(ack.wait_s)

    def _count(self, item: _Waiting, sign: int) -> None:
        self.steps += sign * item.steps
        self._bytes += sign * len(item.payload)
        self._metrics.outbox.set(self.steps)

    def _send(self, item: _Waiting) -> Ack | None:
        """Send until answered or closed; once only when the outbox is to be emptied."""
        back_off_s, longest_s = _BACK_OFF_S
        while not self._closing:
            begin = perf_counter()
            self._metrics.messages_sent.inc()
            self._metrics.sent_bytes.inc(len(item.payload))
            reply = self._bus.ask(self._key, item.payload, _ASK_TIMEOUT_S)
            ack = None
            with contextlib.suppress(MalformedMessageError):  # then it is sent again
                ack = None if reply is None else decode(reply, Ack)
            if ack is not None and ack.verdict == "unknown":
                self._on_unknown()
            elif ack is not None:
                self._metrics.send_seconds.observe(perf_counter() - begin)
                self._metrics.acks.labels(ack.verdict).inc()
                return ack
            if self._draining:
                return None
            self._metrics.retries.inc()
            self._pause(back_off_s * self._random.uniform(0.5, 1.0))
            back_off_s = min(back_off_s * 2, longest_s)
        return None

    def _pause(self, seconds: float) -> None:
        if seconds > 0:
            with self._changed:
                self._changed.wait_for(lambda: self._draining, timeout=seconds)
