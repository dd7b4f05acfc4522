"""The spool: in order, until answered, never more than fits."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from a2s.actors.metrics import Tally
from a2s.actors.outbox import Spool
from a2s.protocol.codec import decode, encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.messages import Ack, Segment, Verdict

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
def _spool(
    exchange: Exchange, capacity_steps: int, tally: Tally
) -> Iterator[tuple[Spool, list[Ack]]]:
    acks: list[Ack] = []
    spool = Spool(InProcessBus(exchange), "k", capacity_steps, acks.append, lambda: None, tally)
    try:
        yield spool, acks
    finally:
        spool.close(0.0)


def test_segments_arrive_in_order_and_are_forgotten_when_answered(wait_for: WaitFor) -> None:
    exchange, seen = Exchange(), list[int]()

    def answer(payload: bytes) -> bytes:
        seen.append(decode(payload, Segment).seq)
        return _ack()

    InProcessBus(exchange).answer("k", answer)
    tally = Tally()
    with _spool(exchange, 1000, tally) as (spool, acks):
        assert all(spool.put(_segment(seq), 1.0) for seq in range(20))
        wait_for(lambda: spool.answered == 20, "20 answers")
        assert (seen, spool.steps, len(acks)) == (list(range(20)), 0, 20)
        assert tally.snapshot()["gauges"]["outbox_transitions"] == 0


def test_a_segment_without_an_answer_is_sent_again_the_same_bytes(wait_for: WaitFor) -> None:
    exchange, payloads, tally = Exchange(), list[bytes](), Tally()

    def deaf_twice(payload: bytes) -> bytes:
        payloads.append(payload)
        if len(payloads) == 1:
            return b"no ack at all"
        return b"" if len(payloads) == 2 else _ack("duplicate")

    InProcessBus(exchange).answer("k", deaf_twice)
    with _spool(exchange, 1000, tally) as (spool, _):
        spool.put(_segment(0), 1.0)
        wait_for(lambda: spool.answered == 1, "an answer")
    assert payloads == [payloads[0]] * 3
    assert tally.total("retries") == 2
    assert tally.snapshot()["counters"]["acks"] == {"duplicate": 1.0}


def test_a_full_spool_takes_nothing_until_the_learner_is_back(wait_for: WaitFor) -> None:
    exchange = Exchange()
    with _spool(exchange, 10, Tally()) as (spool, _):
        assert spool.put(_segment(0), 0.01)
        assert spool.put(_segment(1), 0.01)
        assert not spool.put(_segment(2), 0.01)  # 12 steps do not fit into 10
        assert spool.steps == 8
        InProcessBus(exchange).answer("k", lambda _: _ack())
        assert spool.put(_segment(2), 10.0)
        wait_for(lambda: spool.answered == 3, "3 answers")


def test_a_learner_that_is_behind_is_sent_one_segment_at_a_time(wait_for: WaitFor) -> None:
    exchange = Exchange()
    InProcessBus(exchange).answer("k", lambda _: _ack(wait_s=30.0))
    with _spool(exchange, 1000, Tally()) as (spool, _):
        assert spool.put(_segment(0), 1.0)
        wait_for(lambda: spool.answered == 1, "the answer")
        assert spool.put(_segment(1), 1.0)
        assert not spool.put(_segment(2), 0.01)


def test_a_spool_is_narrowed_but_never_beyond_what_it_was_made_for() -> None:
    with _spool(Exchange(), 10, Tally()) as (spool, _):
        spool.narrow(4)
        assert spool.put(_segment(0), 0.01)
        assert not spool.put(_segment(1), 0.01)
        spool.narrow(100)
        assert spool.put(_segment(1), 0.01)
        assert not spool.put(_segment(2), 0.01)


def test_a_segment_larger_than_the_spool_still_fits_when_it_is_empty() -> None:
    with _spool(Exchange(), 10, Tally()) as (spool, _):
        assert spool.put(_segment(0, steps=50), 0.01)
        assert not spool.put(_segment(1, steps=1), 0.01)


def test_closing_sends_what_waits_within_its_time() -> None:
    exchange = Exchange()
    gate = threading.Event()

    def slow(_: bytes) -> bytes:
        gate.wait(10.0)
        return _ack()

    InProcessBus(exchange).answer("k", slow)
    spool = Spool(InProcessBus(exchange), "k", 1000, lambda _: None, lambda: None, Tally())
    for seq in range(5):
        spool.put(_segment(seq), 1.0)
    gate.set()
    assert spool.close(10.0) == 0
    assert spool.answered == 5


def test_closing_waits_for_no_learner_that_is_gone_and_counts_what_was_never_answered() -> None:
    tally = Tally()
    spool = Spool(InProcessBus(Exchange()), "k", 1000, lambda _: None, lambda: None, tally)
    for seq in range(3):
        spool.put(_segment(seq), 1.0)
    assert spool.close(1e6) == 3
    assert tally.snapshot()["counters"]["dropped_transitions"] == {"shutdown": 12.0}
