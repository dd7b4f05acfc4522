"""Several segments at a time over a link that loses questions and answers."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ingest_runs import QUOTA, IngestRun
from learners import SPACES
from segments import segment

from a2s.actors.metrics import ActorMetrics
from a2s.actors.outbox import Outbox
from a2s.protocol.codec import decode, encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.messages import Hello, Notice, Segment

WaitFor = Callable[..., None]
NUM_SEGMENTS = 60


@pytest.mark.parametrize("seed", range(4))
def test_every_segment_is_taken_once_and_in_order(
    seed: int, tmp_path: Path, make_notice: Callable[..., Notice], wait_for: WaitFor
) -> None:
    """A tenth is lost, half of that only the answer; and once the membership is."""
    run, rng, exchange = IngestRun(tmp_path), np.random.default_rng(seed), Exchange()
    run.ingest.begin(make_notice(generation=2, version=5, quota_steps=4), QUOTA, 2)
    run.join("a", next_seq=0)
    lock = threading.Lock()

    def answer(payload: bytes) -> bytes | None:
        with lock:
            fate = rng.random()
        if fate < 0.05:
            return None
        told = encode(run.send(decode(payload, Segment)))
        return None if fate < 0.1 else told

    def join_again() -> None:
        run.ingest.here("a")
        hello = Hello(
            actor="a", num_envs=1, env_id="Test-v0", spaces=SPACES, next_seq=outbox.answered
        )
        run.ingest.hello(hello)

    InProcessBus(exchange).answer("k", answer)
    outbox = Outbox(InProcessBus(exchange), "k", 1000, lambda _: None, join_again, ActorMetrics())
    outbox.window = 8
    for seq in range(NUM_SEGMENTS):
        played = segment(seq, 4, actor="a", generation=2, weights_version=5)
        assert outbox.put(played, 10.0)
        if seq == NUM_SEGMENTS // 2:
            run.ingest.gone("a")
    wait_for(lambda: outbox.answered == NUM_SEGMENTS, "all answers")
    assert outbox.close(1.0) == 0
    assert [stored.seq for stored in run.kept] == list(range(NUM_SEGMENTS))
    accounts = run.ledger.accounts()
    assert (accounts.accepted, accounts.lost) == (NUM_SEGMENTS, 0)
