"""A bounded queue that keeps every segment until the learner has answered it (docs/adr/0034)."""

import contextlib
import random
import threading
from collections import deque
from collections.abc import Callable
from itertools import islice
from time import perf_counter
from typing import NamedTuple

from a2s.actors.metrics import ActorMetrics
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.messages import Ack, Segment
from a2s.protocol.transport import Bus

_ASK_TIMEOUT_S = 5.0
_BACK_OFF_S = (0.05, 1.0)
_MAX_BYTES = 256 << 20


class _Waiting(NamedTuple):
    payload: bytes
    steps: int


class _Asked(NamedTuple):
    answer: Callable[[], bytes | None]
    begin_s: float


class Outbox:
    """Sends segments in order, several at a time, each until it is answered.

    At least once on the wire: when a segment gets no answer it is sent again, the same bytes, and
    all that were sent after it; until it is answered nothing else is under way. When the
    outbox is full :meth:`put` blocks, so that an absent learner holds the actor back instead of
    filling its memory: ``capacity_steps`` may wait besides those under way behind the oldest, in at
    most 256 MiB, and at least one segment always fits. On a thread of its own, ``on_ack`` gets
    every answer, and ``on_unknown`` is called when the learner does not know this actor.

    Attributes:
        window: Segments that may be without an answer at a time.
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
        self._asked: deque[_Asked] = deque()  # of the first of those that wait
        self._times_begun_again = 0
        self.window = 1
        self.steps = self._bytes = 0
        self._random = random.Random()  # the global one is the environments'
        self.answered = 0
        self._draining = self._closing = False
        self._held_back = False  # the learner is behind
        self._one_by_one = False
        self._hold_until_s = 0.0
        self._changed = threading.Condition()
        self._threads = [
            threading.Thread(target=run, name=f"outbox {run.__name__}")
            for run in (self._ask_all, self._hear_all)
        ]
        for thread in self._threads:
            thread.start()
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
        under_way = sum(each.steps for each in islice(self._waiting, 1, len(self._asked)))
        waiting = self.steps - under_way
        fits = waiting + item.steps <= self._capacity_steps and not self._held_back
        return fits and self._bytes + len(item.payload) <= _MAX_BYTES

    def close(self, timeout_s: float) -> int:
        """Stop taking, send what waits, and end the threads; give the count of unanswered segments.

        It takes ``timeout_s`` seconds and one request at most. A learner that does not answer is
        not asked again: usually its run is over.
        """
        with self._changed:
            self._draining = True
            self._changed.notify_all()
        self._threads[-1].join(timeout_s)
        self._end()
        for thread in self._threads:
            thread.join(_ASK_TIMEOUT_S)
        left = sum(item.steps for item in self._waiting)
        if left:
            self._metrics.dropped.labels("shutdown").inc(left)
        return len(self._waiting)

    def _end(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def _is_over(self) -> bool:
        return self._closing or (self._draining and not self._waiting)

    def _count(self, item: _Waiting, sign: int) -> None:
        self.steps += sign * item.steps
        self._bytes += sign * len(item.payload)
        self._metrics.outbox.set(self.steps)

    def _ask_all(self) -> None:
        while True:
            with self._changed:
                while not (self._is_over() or self._may_ask()):
                    self._changed.wait(self._hold_s() or None)
                if self._is_over():
                    return
                item, begun = self._waiting[len(self._asked)], self._times_begun_again
            self._metrics.messages_sent.inc()
            self._metrics.sent_bytes.inc(len(item.payload))
            begin_s = perf_counter()
            answer = self._bus.begin_asking(self._key, item.payload, _ASK_TIMEOUT_S)
            with self._changed:
                if begun == self._times_begun_again:
                    self._asked.append(_Asked(answer, begin_s))
                    self._changed.notify_all()
                else:
                    self._metrics.retries.inc()

    def _may_ask(self) -> bool:
        at_most = 1 if self._held_back or self._one_by_one else self.window
        return not self._hold_s() and len(self._asked) < min(at_most, len(self._waiting))

    def _hold_s(self) -> float:
        """Seconds until a segment may be sent; the last time, nothing is waited for."""
        return 0.0 if self._draining else max(0.0, self._hold_until_s - perf_counter())

    def _hear_all(self) -> None:
        back_off_s, longest_s = _BACK_OFF_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_over() or bool(self._asked))
                if self._is_over():
                    return
                asked = self._asked[0]
            ack = _decoded(asked.answer())
            if ack is None or ack.verdict == "unknown":
                under_way = self._begin_again(back_off_s * self._random.uniform(0.5, 1.0))
                if ack is not None:
                    self._on_unknown()
                if self._draining:
                    self._end()
                    return
                self._metrics.retries.inc(under_way)
                back_off_s = min(back_off_s * 2, longest_s)
            else:
                back_off_s = _BACK_OFF_S[0]
                self._forget(asked, ack)
                self._on_ack(ack)

    def _begin_again(self, after_s: float) -> int:
        """Nothing is under way any more; first of all comes the oldest. Gives how many were."""
        with self._changed:
            under_way = len(self._asked)
            self._asked.clear()
            self._times_begun_again += 1
            self._one_by_one = True
            self._hold_until_s = perf_counter() + after_s
            self._changed.notify_all()
        return under_way

    def _forget(self, asked: _Asked, ack: Ack) -> None:
        """The oldest is answered; how long to wait, only the last answer knows."""
        self._metrics.send_seconds.observe(perf_counter() - asked.begin_s)
        self._metrics.acks.labels(ack.verdict).inc()
        with self._changed:
            self._asked.popleft()
            self._count(self._waiting.popleft(), -1)
            self.answered += 1
            self._one_by_one = False
            self._held_back = ack.wait_s > 0
            self._hold_until_s = perf_counter() + ack.wait_s
            self._changed.notify_all()


def _decoded(reply: bytes | None) -> Ack | None:
    """Read an answer; bytes that are none count as silence."""
    with contextlib.suppress(MalformedMessageError):
        return None if reply is None else decode(reply, Ack)
    return None
