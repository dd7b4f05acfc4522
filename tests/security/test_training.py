"""A run whose peers all have certificates learns as any other."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learners import SPACES, learner_of
from secured import free_port

from a2s.protocol.certificates import Authority
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Hello, Notice, Segment, Welcome
from a2s.protocol.zenoh_bus import ZenohBus

NAME = "actor-lab1.scripted"
OPTIONS = {"env": "Test-v0", "n": 1, "envs": 1, "run": "r", "total_steps": 96}
SETTINGS = {
    "batch_steps": 32, "first_batch_steps": 32, "critic_epochs": 1, "policy_epochs": 1,
    "policy_sizes": (8,), "value_sizes": (8,), "q_sizes": (8,),
}  # fmt: skip


def test_a_learner_learns_from_an_actor_with_a_certificate(certs: Path, tmp_path: Path) -> None:
    """Over TLS, by the keys that only this actor may ask."""
    keys, own = Keys("r"), Security(tls=str(certs))
    endpoint = own.endpoint(f"tcp/127.0.0.1:{free_port()}")
    with (
        closing(ZenohBus.listen(endpoint, own.listener(keys, endpoint))) as bus,
        ThreadPoolExecutor(1) as thread,
    ):
        learner = learner_of(OPTIONS, SETTINGS, bus, tmp_path)
        learning = thread.submit(learner.run, lambda: False)
        identity = Security(tls=str(certs / "actor-lab1")).peer("actor")
        with closing(ZenohBus.connect(endpoint, lambda: False, identity)) as actor:
            _play(actor, keys, learning)
    summary = learning.result()
    assert (summary["finished"], summary["updates"], summary["env_steps"]) == (True, 3, 96)


def test_a_restarted_learner_is_found_again_by_an_actor_with_a_certificate(certs: Path) -> None:
    """By the same session: its questions go on, and so does its presence."""
    keys, own = Keys("r"), Security(tls=str(certs))
    endpoint = own.endpoint(f"tcp/127.0.0.1:{free_port()}")
    live = keys.live_actor(NAME)
    with ExitStack() as stack:

        def listen(answer: bytes) -> ZenohBus:
            bus = ZenohBus.listen(endpoint, own.listener(keys, endpoint))
            bus.answer_each(keys.segment_of(), lambda name, _: name.encode() + answer)
            return stack.enter_context(closing(bus))

        first = listen(b" first")
        identity = Security(tls=str(certs / "actor-lab1")).peer("actor")
        actor = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False, identity)))
        actor.declare_presence(live)
        _until(lambda: actor.ask(keys.segment_of(NAME), b"", 5.0) == f"{NAME} first".encode())
        first.close()
        second = listen(b" second")
        _until(lambda: actor.ask(keys.segment_of(NAME), b"", 5.0) == f"{NAME} second".encode())
        _until(lambda: second.present(keys.live_actor(), 1.0) == [live])


def test_a_link_ends_when_its_certificate_does(certs: Path, tmp_path: Path) -> None:
    """And the peer is told so when it connects again."""
    keys, own = Keys("r"), Security(tls=str(certs))
    endpoint = own.endpoint(f"tcp/127.0.0.1:{free_port()}")
    now = datetime.now(UTC)
    yesterday = now - timedelta(days=1) + timedelta(seconds=3)
    for name, data in Authority.read(certs, now).issue("actor", [], 1, yesterday).items():
        (tmp_path / name).write_bytes(data)
    with closing(ZenohBus.listen(endpoint, own.listener(keys, endpoint))) as bus:
        bus.answer(keys.status, lambda _: b"told")
        identity = Security(tls=str(tmp_path)).peer("actor")
        with closing(ZenohBus.connect(endpoint, lambda: False, identity)) as actor:
            _until(lambda: actor.ask(keys.status, b"", 1.0) == b"told")
            _until(lambda: actor.ask(keys.status, b"", 1.0) is None)
    with pytest.raises(UsageError, match=r"cert\.pem: expired on"):
        Security(tls=str(tmp_path)).peer("actor")


def _until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        threading.Event().wait(0.02)


def _play(bus: ZenohBus, keys: Keys, learning: "Future[dict[str, Any]]") -> None:
    """Join, then play the quota of every version until the learner has ended."""
    bus.declare_presence(keys.live_actor(NAME))
    hello = Hello(actor=NAME, num_envs=1, env_id="Test-v0", spaces=SPACES)
    while (answer := bus.ask(keys.hello_of(NAME), encode(hello), 5.0)) is None:
        threading.Event().wait(0.01)
    welcome, played = decode(answer, Welcome), 0
    assert isinstance(welcome, Welcome)
    while not learning.done():
        told = bus.ask(keys.notice, b"", 5.0)
        notice = decode(told, Notice) if told else None
        if not isinstance(notice, Notice) or notice.version == played:
            threading.Event().wait(0.01)
            continue
        segment = _segment(notice, welcome.generation, played)
        answer = bus.ask(keys.segment_of(NAME), encode(segment), 5.0)
        if answer is not None:
            ack = decode(answer, Ack)
            assert isinstance(ack, Ack)
            assert ack.verdict == "accepted", ack
            played = notice.version


def _segment(notice: Notice, generation: int, seq: int) -> Segment:
    rng, steps = np.random.default_rng(notice.version), notice.quota_steps
    suggestion = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
    return Segment(
        actor=NAME, seq=seq, generation=generation, epoch=notice.epoch,
        weights_version=notice.version, env=0, suggestion=suggestion,
        obs=rng.standard_normal((steps, 2)).astype(np.float32),
        log_prob=np.full(steps, -1.0, np.float32), reward=suggestion[:, 0],
        final_obs=np.zeros(2, np.float32), terminated=True, truncated=False,
        episode_return=0.0, episode_length=steps,
    )  # fmt: skip
