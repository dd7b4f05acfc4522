"""The bytes of messages, and what other releases and languages may write."""

import json
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import Any

import msgpack
import numpy as np
import pytest
from message_examples import (
    DEFAULTS,
    ENV,
    EXAMPLES,
    GOLDEN,
    KINDS,
    SPACES,
    altered,
    body_of,
    f32,
    plain,
    refusal_of,
)

from a2s.protocol.codec import MAX_BYTES, Message, decode, encode, refuse_major_1
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Ack, EpisodeMetric, Hello, RunStatus, Segment, Weights, Welcome
from a2s.protocol.replay_messages import ReplayInfo


def with_defaults(value: Any) -> Any:
    """Give every field of a message and its parts its default, where it has one."""
    if isinstance(value, tuple):
        return tuple(map(with_defaults, value))
    if not is_dataclass(value) or isinstance(value, type):
        return value
    kept = {f.name: with_defaults(getattr(value, f.name)) for f in fields(value)}
    return type(value)(**kept | DEFAULTS.get(type(value), {}))


def without_defaults(value: Any, body: Any) -> Any:
    """Leave out of the maps of a message every field that has a default."""
    if isinstance(value, tuple):
        return [without_defaults(v, b) for v, b in zip(value, body, strict=True)]
    if not is_dataclass(value):
        return body
    kept = body.keys() - DEFAULTS.get(type(value), {}).keys()
    return {k: without_defaults(getattr(value, k, b), b) for k, b in body.items() if k in kept}


def test_there_is_an_example_and_a_limit_for_every_kind() -> None:
    """A new kind cannot be forgotten here, nor can a new default."""
    assert set(EXAMPLES) == set(MAX_BYTES) == set(KINDS)
    for kind in (*KINDS, Spaces, EnvConfig, EpisodeMetric):
        assert DEFAULTS.get(kind, {}) == {
            f.name: f.default for f in fields(kind) if f.default is not MISSING
        }


@pytest.mark.parametrize(("message", "payload"), GOLDEN)
def test_the_bytes_of_a_message_never_change(message: Message, payload: bytes) -> None:
    """Actors of another language or release read them."""
    assert encode(message) == payload
    assert plain(decode(payload, type(message))) == plain(message)


@pytest.mark.parametrize(("message", "payload"), GOLDEN)
def test_what_has_a_default_need_not_be_there(message: Message, payload: bytes) -> None:
    """In a part of a message neither: senders of an earlier release know nothing of it."""
    bare = msgpack.packb(without_defaults(message, msgpack.unpackb(payload)))
    assert plain(decode(bare, type(message))) == plain(with_defaults(message))


@pytest.mark.parametrize("kind", [Welcome, ReplayInfo])
def test_the_largest_observations_have_room(kind: type) -> None:
    """Otherwise the learner could not answer, and its actors would ask for ever."""
    spaces = replace(SPACES, obs_size=1_000_000, obs_offset=np.ones(1_000_000, np.float32))
    env = {"env": replace(ENV, kwargs=json.dumps({"n": "x" * 900_000}))} if kind is Welcome else {}
    message = replace(EXAMPLES[kind][0], spaces=spaces, **env)
    assert plain(decode(encode(message), kind)) == plain(message)


def test_arrays_of_any_layout_are_sent_as_little_endian_float32_in_c_order() -> None:
    """A view, a transpose or a float64 array is the sender's business."""
    obs: Any = np.arange(12, dtype=">f8").reshape(3, 4).T[::2]  # [2, 3]
    message: Any = replace(
        EXAMPLES[Segment][0], obs=obs, suggestion=f32([[0], [0]]), log_prob=f32([0, 0]),
        reward=f32([0, 0]), final_obs=f32([0, 0, 0]), episode_length=2,
    )  # fmt: skip
    found = decode(encode(message), Segment).obs
    assert found.dtype == np.dtype("<f4")
    assert found.tolist() == [[0.0, 4.0, 8.0], [2.0, 6.0, 10.0]]


def test_decoded_arrays_cannot_be_changed() -> None:
    """A message is immutable, its arrays included."""
    with pytest.raises(ValueError, match="read-only"):
        decode(EXAMPLES[Segment][1], Segment).reward[0] = 1


@pytest.mark.parametrize("kind", KINDS)
def test_each_missing_field_without_a_default_is_named(kind: type) -> None:
    """So that who wrote the sender knows what to add."""
    required = [f.name for f in fields(kind) if f.name not in DEFAULTS.get(kind, {})]
    for name in required:
        payload = msgpack.packb({k: v for k, v in body_of(kind).items() if k != name})
        assert refusal_of(payload, kind) == f"{kind.__name__}: missing fields ['{name}']"
    bare = msgpack.packb({"a2s": 2, "kind": kind.__name__})
    assert refusal_of(bare, kind) == f"{kind.__name__}: missing fields {required}"


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        *((kind, []) for kind in KINDS),
        (Hello, ["spaces"]),
        (Welcome, ["env"]),
        (Segment, ["metrics", 0]),
        (Weights, ["notice"]),
        (RunStatus, ["actors", 0]),
    ],
)
def test_an_unknown_field_is_passed_over(kind: type, place: list[Any]) -> None:
    """Wherever it stands and whatever it holds: a sender of a later release may have it."""
    values: list[Any] = ["red", None, {"of": ["what", {}]}, msgpack.ExtType(5, b"x"), [[]] * 99]
    for value in values:
        body: Any = body_of(kind)
        part = body
        for step in place:
            part = part[step]
        known = dict(part)
        part.clear()
        part |= {"colour": value, **known, "weight of it": value}
        found: Any = decode(msgpack.packb(body), kind)
        assert plain(found) == plain(EXAMPLES[kind][0])


def test_an_integer_is_a_number() -> None:
    """Msgpack libraries of other languages shorten 2.0 to 2; integers go up to 2^63 - 1."""
    ack = decode(altered(Ack, wait_s=2, generation=2**63 - 1), Ack)
    assert (type(ack.wait_s), ack.wait_s, ack.generation) == (float, 2.0, 2**63 - 1)


def test_of_a_key_that_comes_twice_the_last_counts() -> None:
    """The first entry may be of any type; it is not looked at."""
    body = altered(Ack, wait_s=2.0)
    header, entries = bytes([body[0] + 1]), body[1:]  # one entry more
    twice = msgpack.packb("wait_s") + msgpack.packb("soon")
    assert decode(header + twice + entries, Ack).wait_s == 2.0
    reason = refusal_of(header + entries + twice, Ack)
    assert reason == "Ack.wait_s: found 'soon', expected a number"


def test_an_actor_of_protocol_1_can_read_why_it_is_refused() -> None:
    """It takes version 1 alone, exactly the fields that it knows, and shows the reason."""
    payload = refuse_major_1()
    assert payload.startswith(b"\x83\xa3a2s\x01\xa4kind\xa7Refusal\xa6reason\xd9")  # a str 8
    reason = msgpack.unpackb(payload)["reason"]
    assert reason.startswith("this actor speaks protocol 1, the learner protocol 2: ")
    assert len(reason.splitlines()) == 1
    assert refusal_of(payload) == "peer speaks protocol 1, this is 2"
