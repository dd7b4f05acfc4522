"""What a learner refuses, over real zenoh: with a reason, counted, and training goes on."""

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from system_helpers import FAST, PATIENCE_S, Start, metrics_port, scrape

from a2s.actors.environments.environment import Environment
from a2s.protocol.codec import MAX_BYTES, decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, ActorStatus, Hello, Refusal, Segment, Welcome
from a2s.protocol.zenoh_bus import ZenohBus

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

ENV = "a2s_test_envs:Count-v0"
WaitFor = Callable[..., None]


def _segment(welcome: Welcome, **fields: Any) -> Segment:
    ones = np.ones(5, dtype=np.float32)
    values = {
        "actor": "peer", "seq": 0, "generation": welcome.generation, "epoch": 0,
        "weights_version": 1, "env": 0, "obs": np.ones((5, 2), dtype=np.float32),
        "suggestion": np.ones((5, 2), dtype=np.float32), "log_prob": ones, "reward": ones,
        "final_obs": np.ones(2, dtype=np.float32), "terminated": True, "truncated": False,
        "episode_return": 5.0, "episode_length": 5,
    }  # fmt: skip
    return Segment(**{**values, **fields})


def _with_nan(segment: Segment) -> bytes:
    """The bytes of a segment whose third reward is not a number, which no actor of ours sends."""
    body = msgpack.unpackb(encode(segment))
    reward = segment.reward.copy()
    reward[2] = np.nan
    body["reward"]["data"] = reward.tobytes()
    return bytes(msgpack.packb(body))


def _with(payload: bytes, **fields: object) -> bytes:
    return bytes(msgpack.packb({**msgpack.unpackb(payload), **fields}))


def test_wrong_peers_are_refused_counted_and_do_not_disturb(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    path = tmp_path / "run"
    learner = start(
        "learner", "--env", ENV, *FAST, "--listen", endpoint, "--run-dir", str(path),
        "--metrics-port", "0", "--total-steps", "4000", "--n", "2",
    )  # fmt: skip
    wait_for(lambda: "/metrics" in learner.text(), "the learner")
    port, keys = metrics_port(learner), Keys("default")
    spaces = Environment(EnvConfig(env_id=ENV)).spaces
    hello = encode(Hello(actor="peer", num_envs=1, env_id=ENV, spaces=spaces))

    with closing(ZenohBus.connect(endpoint, lambda: True)) as bus:

        def ask(key: str, payload: bytes) -> Welcome | Refusal | Ack:
            reply = bus.ask(key, payload, 20.0)
            assert reply is not None
            return decode(reply, Welcome, Refusal, Ack)  # type: ignore[return-value]

        def refused(key: str, payload: bytes) -> str:
            answer = ask(key, payload)
            assert not isinstance(answer, Welcome)
            assert isinstance(answer, Refusal) or answer.verdict == "refused"
            return answer.reason

        wait_for(lambda: bus.ask(keys.notice, b"", 5.0), "the first weights")
        assert "protocol 99, this is 2" in refused(keys.hello, _with(hello, a2s=99))
        other = encode(Hello(actor="peer", num_envs=1, env_id="Hopper-v5", spaces=spaces))
        assert f"found Hopper-v5, expected {ENV}" in refused(keys.hello, other)
        wide = replace(spaces, obs_size=3)
        assert "found obs_size 3, expected 2" in refused(
            keys.hello, encode(Hello(actor="peer", num_envs=1, env_id=ENV, spaces=wide))
        )
        assert bus.ask(keys.hello, hello, 20.0) is None  # nobody would see it leave
        bus.declare_presence(keys.live_actor("peer"))
        wait_for(lambda: bus.ask(keys.hello, hello, 20.0) is not None, "an answer")
        welcome = ask(keys.hello, hello)
        assert isinstance(welcome, Welcome)
        good = _segment(welcome)
        assert "not msgpack" in refused(keys.segment, b"\xc1garbage")
        assert "expected at most" in refused(keys.segment, bytes(MAX_BYTES[Segment] + 1))
        assert "reward: found nan" in refused(keys.segment, _with_nan(good))
        assert "protocol 99" in refused(keys.segment, _with(encode(good), a2s=99))
        stranger = _segment(welcome, actor="stranger")
        unknown = ask(keys.segment, encode(stranger))
        assert isinstance(unknown, Ack)
        assert unknown.verdict == "unknown"
        future = _segment(welcome, seq=1, weights_version=10**6)
        assert "not published" in refused(keys.segment, encode(future))

        seen = scrape(port)
        for message, reason, times in [
            ("hello", "schema", 1), ("hello", "environment", 2), ("segment", "malformed", 2),
            ("segment", "oversize", 1), ("segment", "schema", 1), ("segment", "unknown_actor", 1),
            ("segment", "future", 1),
        ]:  # fmt: skip
            name = f'a2s_learner_messages_refused_total{{message="{message}",reason="{reason}"}}'
            assert seen[name] == times, name
        leaves = ActorStatus(
            actor="peer", slot=welcome.slot, weights_version=0, epoch=0, env_steps=0, episodes=0,
            segments_sent=0, segments_answered=0, spooled_steps=0, leaving=True,
        )  # fmt: skip
        bus.publish(keys.actor_status("peer"), encode(leaves))

    strict = start("actor", "--allow-env", "mine", "--connect", endpoint, "--metrics-port", "-1")
    assert strict.process.wait(PATIENCE_S) == 1
    last = strict.text().splitlines()[-1]
    assert last.startswith(f"a2s: environment '{ENV}': the learner wants")
    assert last.endswith("--allow-env a2s_test_envs")
    said = f"cannot join: {last.partition(': ')[2]}"
    wait_for(lambda: said in learner.text(), "the learner says so, too")
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "-1")
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    summary = json.loads((path / "summary.json").read_text())
    segments = summary["segments"]
    assert summary["finished"]
    assert segments["refused"] == 1  # the one that could be read, of an actor that had joined
    assert segments["sent"] == sum(segments[k] for k in ("accepted", "stale", "refused", "lost"))
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    assert sum(e["event"] == "refusal" for e in events) == 8
    assert "Traceback" not in learner.text() + actor.text()
