"""The outbox: in order, until answered, never more than fits, several at a time over a network."""

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from types import MappingProxyType

import numpy as np

from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.outbox import Outbox
from a2s.commands.process import free_endpoint
from a2s.protocol.codec import decode, encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.messages import Ack, Segment, Verdict
from a2s.protocol.zenoh_bus import ZenohBus

WaitFor = Callable[..., None]


def _segment(seq: int, steps: int = 4) -> Segment:
    ones = np.ones(steps, dtype=np.float32)
    return Segment(
        actor="tester", seq=seq, generation=1, epoch=0, weights_version=1, env=0,
        obs=np.ones((steps, 2), dtype=np.float32),
        suggestion=np.ones((steps, 1), dtype=np.float32), log_prob=ones, reward=ones,
        final_obs=np.ones(2, dtype=np.float32), terminated=False, truncated=False,
        episode_return=float(steps), episode_length=steps,
    )  # fmt: skip


def _ack(verdict: Verdict = "accepted", wait_s: float = 0.0) -> bytes:
    return encode(
        Ack(verdict=verdict, reason="", generation=1, epoch=0, weights_version=1, wait_s=wait_s)
    )


@contextmanager
def _outbox(
    exchange: Exchange, capacity_steps: int, metrics: ActorMetrics
) -> Iterator[tuple[Outbox, list[Ack]]]:
    acks: list[Ack] = []
    outbox = Outbox(InProcessBus(exchange), "k", capacity_steps, acks.append, lambda: None, metrics)
    try:
        yield outbox, acks
    finally:
        outbox.close(0.0)


def test_segments_arrive_in_order_and_are_forgotten_when_answered(wait_for: WaitFor) -> None:
    exchange, seen = Exchange(), list[int]()

    def answer(payload: bytes) -> bytes:
        seen.append(decode(payload, Segment).seq)
        return _ack()

    InProcessBus(exchange).answer("k", answer)
    metrics = ActorMetrics()
    with _outbox(exchange, 1000, metrics) as (outbox, acks):
        assert all(outbox.put(_segment(seq), 1.0) for seq in range(20))
        wait_for(lambda: outbox.answered == 20, "20 answers")
        assert (seen, outbox.steps, len(acks)) == (list(range(20)), 0, 20)
        assert metrics.registry.get_sample_value("a2s_actor_outbox_transitions") == 0


def test_a_segment_without_an_answer_is_sent_again_the_same_bytes(wait_for: WaitFor) -> None:
    exchange, payloads, metrics = Exchange(), list[bytes](), ActorMetrics()

    def deaf_twice(payload: bytes) -> bytes:
        payloads.append(payload)
        if len(payloads) == 1:
            return b"no ack at all"
        return b"" if len(payloads) == 2 else _ack("duplicate")

    InProcessBus(exchange).answer("k", deaf_twice)
    with _outbox(exchange, 1000, metrics) as (outbox, _):
        outbox.put(_segment(0), 1.0)
        wait_for(lambda: outbox.answered == 1, "an answer")
    assert payloads == [payloads[0]] * 3
    assert total(metrics.retries) == 2
    assert total(metrics.acks) == total(metrics.acks.labels("duplicate")) == 1


def test_a_full_outbox_takes_nothing_until_the_learner_is_back(wait_for: WaitFor) -> None:
    exchange = Exchange()
    with _outbox(exchange, 10, ActorMetrics()) as (outbox, _):
        assert outbox.put(_segment(0), 0.01)
        assert outbox.put(_segment(1), 0.01)
        assert not outbox.put(_segment(2), 0.01)  # 12 steps do not fit into 10
        assert outbox.steps == 8
        InProcessBus(exchange).answer("k", lambda _: _ack())
        assert outbox.put(_segment(2), 10.0)
        wait_for(lambda: outbox.answered == 3, "3 answers")


def test_a_learner_that_is_behind_is_sent_one_segment_at_a_time(wait_for: WaitFor) -> None:
    exchange = Exchange()
    InProcessBus(exchange).answer("k", lambda _: _ack(wait_s=30.0))
    with _outbox(exchange, 1000, ActorMetrics()) as (outbox, _):
        assert outbox.put(_segment(0), 1.0)
        wait_for(lambda: outbox.answered == 1, "the answer")
        assert outbox.put(_segment(1), 1.0)
        assert not outbox.put(_segment(2), 0.01)


def test_of_the_answers_to_all_under_way_the_last_says_how_long_to_wait(wait_for: WaitFor) -> None:
    with ExitStack() as stack:
        far = _Far(stack, 4, set(), hold_s=dict.fromkeys(range(3), 60.0))
        assert all(far.outbox.put(_segment(seq), 1.0) for seq in range(5))
        wait_for(lambda: total(far.metrics.messages_sent) == 4, "a full window")
        far.gate.set()
        wait_for(lambda: far.outbox.answered == 5, "5 answers")


def test_a_outbox_is_narrowed_but_never_beyond_what_it_was_made_for() -> None:
    with _outbox(Exchange(), 10, ActorMetrics()) as (outbox, _):
        outbox.narrow(4)
        assert outbox.put(_segment(0), 0.01)
        assert not outbox.put(_segment(1), 0.01)
        outbox.narrow(100)
        assert outbox.put(_segment(1), 0.01)
        assert not outbox.put(_segment(2), 0.01)


def test_a_segment_larger_than_the_outbox_still_fits_when_it_is_empty() -> None:
    with _outbox(Exchange(), 10, ActorMetrics()) as (outbox, _):
        assert outbox.put(_segment(0, steps=50), 0.01)
        assert not outbox.put(_segment(1, steps=1), 0.01)


def test_closing_sends_what_waits_within_its_time() -> None:
    exchange = Exchange()
    gate = threading.Event()

    def slow(_: bytes) -> bytes:
        gate.wait(10.0)
        return _ack()

    InProcessBus(exchange).answer("k", slow)
    outbox = Outbox(InProcessBus(exchange), "k", 1000, lambda _: None, lambda: None, ActorMetrics())
    for seq in range(5):
        outbox.put(_segment(seq), 1.0)
    gate.set()
    assert outbox.close(10.0) == 0
    assert outbox.answered == 5


def test_closing_waits_for_no_learner_that_is_gone_and_counts_what_was_never_answered() -> None:
    metrics = ActorMetrics()
    outbox = Outbox(InProcessBus(Exchange()), "k", 1000, lambda _: None, lambda: None, metrics)
    for seq in range(3):
        outbox.put(_segment(seq), 1.0)
    assert outbox.close(1e6) == 3
    assert total(metrics.dropped) == total(metrics.dropped.labels("shutdown")) == 12


class _Far:
    """An outbox, and a learner behind a network that answers when the gate is open.

    Segments whose number is in ``lost`` are heard of once too often: the first time, not at all. As
    a learner does, it takes them in order; some answers say how long to wait, ``hold_s``.
    """

    def __init__(
        self,
        stack: ExitStack,
        window: int,
        lost: set[int],
        capacity_steps: int = 1000,
        hold_s: Mapping[int, float] = MappingProxyType({}),
    ) -> None:
        self.gate, self.heard, self.taken = threading.Event(), list[int](), list[int]()
        self.most_unanswered, self._lost, self._hold_s = 0, lost, hold_s
        self.metrics = ActorMetrics()
        endpoint = free_endpoint()
        learner = stack.enter_context(closing(ZenohBus.listen(endpoint)))
        learner.answer_in_turn("k", self._answer, bytes, 100)
        actor = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False)))
        self.outbox = Outbox(actor, "k", capacity_steps, lambda _: None, lambda: None, self.metrics)
        self.outbox.window = window
        stack.callback(self.outbox.close, 0.0)
        stack.callback(self.gate.set)

    def _answer(self, payload: bytes) -> bytes | None:
        self.gate.wait(20.0)
        seq = decode(payload, Segment).seq
        self.heard.append(seq)
        if seq in self._lost:
            self._lost.discard(seq)
            return None
        if seq > len(self.taken):
            return _ack("unknown")
        unanswered = total(self.metrics.messages_sent) - len(self.taken)
        self.most_unanswered = max(self.most_unanswered, int(unanswered))
        if seq < len(self.taken):
            return _ack("duplicate")
        self.taken.append(seq)
        return _ack(wait_s=self._hold_s.get(seq, 0.0))


def test_as_many_as_the_window_are_under_way(wait_for: WaitFor) -> None:
    with ExitStack() as stack:
        far = _Far(stack, 4, set())
        assert all(far.outbox.put(_segment(seq), 1.0) for seq in range(20))
        wait_for(lambda: total(far.metrics.messages_sent) == 4, "a full window")
        far.gate.set()
        wait_for(lambda: far.outbox.answered == 20, "20 answers")
        assert far.heard == list(range(20))
        assert far.most_unanswered == 4


def test_those_under_way_leave_room_for_others(wait_for: WaitFor) -> None:
    """The oldest and one more wait, as 8 steps may; three are under way."""
    with ExitStack() as stack:
        far = _Far(stack, 4, set(), capacity_steps=8)
        assert all(far.outbox.put(_segment(seq), 10.0) for seq in range(5))
        wait_for(lambda: total(far.metrics.messages_sent) == 4, "a full window")
        assert not far.outbox.put(_segment(5), 0.01)
        far.gate.set()
        assert far.outbox.put(_segment(5), 10.0)


def test_when_one_is_lost_it_is_sent_alone_then_all_after_it_in_order(wait_for: WaitFor) -> None:
    with ExitStack() as stack:
        far = _Far(stack, 4, {2})
        assert all(far.outbox.put(_segment(seq), 1.0) for seq in range(10))
        wait_for(lambda: total(far.metrics.messages_sent) == 4, "a full window")
        far.gate.set()
        wait_for(lambda: far.outbox.answered == 10, "10 answers")
        assert far.taken == list(range(10))
        again = far.heard.index(2, far.heard.index(2) + 1)
        assert set(far.heard[3:again]) <= {3, 4, 5}  # under way when it was lost
        assert far.heard[again:] == list(range(2, 10))
        assert total(far.metrics.retries) == total(far.metrics.messages_sent) - 10
        assert far.outbox.steps == 0
