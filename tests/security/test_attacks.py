"""What a peer that is let in cannot do: the table of docs/security.md, over real zenoh.

Each is tried with certificates and with passwords, for which the rules are the same.
"""

import json
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from learners import SPACES
from secured import Site

from a2s.protocol import zenoh_bus, zenoh_session
from a2s.protocol.codec import decode, encode
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    Hello,
    Notice,
    Refusal,
    Segment,
    Weights,
    Welcome,
)

WaitFor = Callable[..., None]
EXPECTED_SILENCE_S = 2.0


def hello(actor: str) -> bytes:
    return encode(Hello(actor=actor, num_envs=1, env_id="Test-v0", spaces=SPACES))


def join(peer: zenoh_bus.ZenohBus, keys: Keys, name: str, wait_for: WaitFor) -> Welcome:
    """Join with a token; until the learner has seen it there is silence."""
    peer.declare_presence(keys.live_actor(name))
    answers = list[bytes]()

    def asked() -> bool:
        answers.extend(filter(None, [peer.ask(keys.hello_of(name), hello(name), 5.0)]))
        return bool(answers)

    wait_for(asked, "a welcome")
    welcome = decode(answers[0], Welcome)
    assert isinstance(welcome, Welcome)
    return welcome


def status(actor: str, **fields: Any) -> bytes:
    values = {
        "slot": 0, "weights_version": 1, "epoch": 0, "env_steps": 0, "episodes": 0,
        "segments_sent": 0, "segments_answered": 0, "spooled_steps": 0, "leaving": False,
        "environment_s": 0.0, "selection_s": 0.0, "sending_s": 0.0, "waiting_s": 0.0,
    }  # fmt: skip
    return encode(ActorStatus(actor=actor, **{**values, **fields}))


def segment(actor: str, generation: int) -> bytes:
    two = np.zeros(2, np.float32)
    played = Segment(
        actor=actor, seq=0, generation=generation, epoch=0, weights_version=1, env=0,
        obs=np.zeros((2, 2), np.float32), suggestion=np.zeros((2, 1), np.float32),
        log_prob=two, reward=two, final_obs=two, terminated=True, truncated=False,
        episode_return=0.0, episode_length=2,
    )  # fmt: skip
    return encode(played)


def events(path: Path, kind: str) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    return [event for event in found if event["event"] == kind]


def test_an_actor_answers_no_question_of_others(site: Site, wait_for: WaitFor) -> None:
    """A rogue queryable on `weights` gets no query, nor one on everything."""
    rogue, victim = site.peer("actor"), site.peer("actor-lab1")
    heard = list[bytes]()

    def answer(question: bytes) -> bytes:
        heard.append(question)
        return b"rogue"

    keys = site.keys
    for key in (keys.weights, keys.hello, keys.hello_of(), keys.notice, f"a2s/2/{keys.run}/**"):
        rogue.answer(key, answer)
    rogue.present(keys.live_learner, 5.0)  # the learner has heard its declarations
    generation = site.status(victim).generation
    for _ in range(10):
        weights = victim.ask(keys.weights, b"", 5.0)
        assert weights is not None
        assert decode(weights, Weights).notice.generation == generation
    join(victim, keys, "actor-lab1.answered", wait_for)
    assert heard == []


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_rogue_that_is_no_client_can_do_no_more(
    site: Site, security: Callable[[str], Security], mode: Any
) -> None:
    """Links between routers are bound by the same rules."""
    settings = {"connect/endpoints": [site.endpoint], "listen/endpoints": []}
    config = zenoh_session.configure(mode, {**settings, **security("actor").peer("actor").settings})
    victim, heard = site.peer("actor-lab1"), list[bytes]()
    victim.subscribe(site.keys.notice, heard.append)
    with closing(zenoh_bus.ZenohBus(zenoh.open(config))) as rogue:
        rogue.answer(site.keys.weights, lambda _: b"rogue")
        rogue.present(site.keys.live_learner, 5.0)
        rogue.publish(site.keys.notice, b"rogue")
        site.status(rogue)
        assert victim.ask(site.keys.weights, b"", 5.0) not in (None, b"rogue")
    assert heard == []


def test_an_actor_announces_nothing_in_the_name_of_the_learner(site: Site) -> None:
    """Others hear the learner's notice, which comes after those of the rogue, and nothing else."""
    rogue, victim = site.peer("actor"), site.peer("actor-lab1")
    heard, ended = list[bytes](), threading.Event()

    def hear(payload: bytes) -> None:
        heard.append(payload)
        if payload == b"end":
            ended.set()

    for key in (site.keys.notice, site.keys.recovery, site.keys.status):
        victim.subscribe(key, hear)
    site.status(victim)
    for key in (site.keys.notice, site.keys.recovery, site.keys.status):
        rogue.publish(key, b"rogue")
    site.status(rogue)
    site.bus.publish(site.keys.recovery, b"end")
    assert ended.wait(10.0)
    assert heard == [b"end"]


def test_an_actor_is_present_under_its_own_name_only(site: Site, wait_for: WaitFor) -> None:
    """Else it could remove another one: a member leaves when its token vanishes."""
    rogue, seen = site.peer("actor"), list[str]()
    site.bus.watch_presence(site.keys.live_actor(), lambda key, _: seen.append(key))
    mine, other = "actor.rogue", "actor-lab1.victim"
    rogue.declare_presence(site.keys.live_actor(other))
    rogue.declare_presence(site.keys.live_learner)
    rogue.declare_presence(site.keys.live_actor(mine))
    wait_for(lambda: site.keys.live_actor(mine) in seen, "its own token")
    assert site.keys.live_actor(other) not in seen
    assert site.keys.live_actor(other) not in site.bus.present(site.keys.live_actor(), 1.0)


def test_an_actor_does_not_report_for_another(site: Site, wait_for: WaitFor) -> None:
    """Neither under the other's key, nor with the other's name under its own."""
    rogue, victim = site.peer("actor"), site.peer("actor-lab1")
    name, mine = "actor-lab1.reports", "actor.rogue"
    join(victim, site.keys, name, wait_for)
    rogue.publish(site.keys.actor_status(name), status(name, leaving=True))
    rogue.publish(site.keys.actor_status(mine), status(name, leaving=True))
    said = f"actor: found {name!r} under the key of {mine!r}"
    wait_for(
        lambda: said in [event["reason"] for event in events(site.path, "refusal")], "the refusal"
    )
    assert name not in [event["actor"] for event in events(site.path, "leave")]


def test_an_actor_does_not_play_for_another(site: Site, wait_for: WaitFor) -> None:
    """A hello or a segment of another is silence under its key, and refused under its own."""
    rogue, victim = site.peer("actor"), site.peer("actor-lab1")
    keys, name, mine = site.keys, "actor-lab1.plays", "actor.rogue"
    welcome = join(victim, keys, name, wait_for)
    theirs = segment(name, welcome.generation)
    for key, message in ((keys.hello_of(name), hello(name)), (keys.segment_of(name), theirs)):
        assert rogue.ask(key, message, EXPECTED_SILENCE_S) is None
    for key in (keys.hello, keys.segment):  # where nobody says who asks
        assert rogue.ask(key, hello(mine), EXPECTED_SILENCE_S) is None
    refused = rogue.ask(keys.hello_of(mine), hello(name), 5.0)
    assert refused is not None
    assert isinstance(decode(refused, Refusal), Refusal)
    answered = rogue.ask(keys.segment_of(mine), theirs, 5.0)
    assert answered is not None
    ack = decode(answered, Ack)
    assert isinstance(ack, Ack)
    assert (ack.verdict, ack.reason) == (
        "refused", f"actor: found {name!r} under the key of {mine!r}"
    )  # fmt: skip


def test_an_actor_hears_nothing_of_others(site: Site) -> None:
    """Neither what they send nor that they are there."""
    rogue, victim = site.peer("actor"), site.peer("actor-lab1")
    heard, name = list[object](), "actor-lab1.private"
    rogue.subscribe(f"a2s/2/{site.keys.run}/**", heard.append)
    rogue.subscribe(site.keys.actor_status(), heard.append)
    rogue.watch_presence(site.keys.live_actor(), lambda key, _: heard.append(key))
    site.status(rogue)
    victim.declare_presence(site.keys.live_actor(name))
    victim.publish(site.keys.actor_status(name), status(name))
    site.status(victim)
    site.status(rogue)
    assert heard == []
    assert rogue.present(site.keys.live_actor(), 1.0) == []


def test_an_actor_does_not_read_the_replay(site: Site) -> None:
    """A viewer does."""
    assert site.peer("actor").ask(site.keys.replay_info, b"", EXPECTED_SILENCE_S) is None
    assert site.peer("viewer").ask(site.keys.replay_info, b"", 5.0) == b"of the replay"


@pytest.mark.parametrize("security", ["certificates"], indirect=True)
def test_another_learner_reads_the_replay_and_no_more(site: Site, certs: Path) -> None:
    """With `--replay-from`; it may do what a viewer may."""
    identity = Security(tls=str(certs)).peer("learner")
    with closing(zenoh_bus.ZenohBus.connect(site.endpoint, lambda: False, identity)) as other:
        site.status(other)
        assert other.ask(site.keys.replay_info, b"", 5.0) == b"of the replay"
        for key in (site.keys.hello, site.keys.hello_of("learner.x")):
            assert other.ask(key, hello("learner.x"), EXPECTED_SILENCE_S) is None


def test_a_viewer_looks_and_changes_nothing(site: Site) -> None:
    """It reads status, notice and weights; hello and segment are silence under any name."""
    viewer, keys = site.peer("viewer"), site.keys
    generation = site.status(viewer).generation
    notice, weights = (viewer.ask(key, b"", 5.0) for key in (keys.notice, keys.weights))
    assert notice is not None
    assert weights is not None
    newest = decode(weights, Weights)
    assert isinstance(newest, Weights)
    assert encode(decode(notice, Notice)) == encode(newest.notice)
    for name in ("viewer", "viewer.x", "actor.x", "actor-lab1.x"):
        viewer.declare_presence(keys.live_actor(name))
        for key in (keys.hello, keys.hello_of(name)):
            assert viewer.ask(key, hello(name), EXPECTED_SILENCE_S) is None
        for key in (keys.segment, keys.segment_of(name)):
            assert viewer.ask(key, segment(name, generation), EXPECTED_SILENCE_S) is None
    for key in (keys.evaluation_task, keys.evaluation_result):
        assert viewer.ask(key, b"", EXPECTED_SILENCE_S) is None
    site.status(viewer)
    seen = site.bus.present(keys.live_actor(), 1.0)
    assert not [key for key in seen if key.endswith((".x", "/viewer"))]


def test_the_learner_is_seen_by_all(site: Site) -> None:
    """And by the question which other runs there are."""
    for name in ("actor", "viewer"):
        found = site.peer(name).present("a2s/2/*/live/learner", 5.0)
        assert found == [site.keys.live_learner]
