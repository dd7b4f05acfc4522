"""What is not a message is refused, with the reason in one line."""

import re
import tracemalloc
from typing import Any

import msgpack
import pytest
from message_examples import EXAMPLES, KINDS, altered, body_of, refusal_of

from a2s.protocol.codec import MAX_BYTES, MIB, decode, encode
from a2s.protocol.counting import has_too_many_values
from a2s.protocol.errors import OversizeMessageError, SchemaMismatchError
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    Hello,
    Notice,
    Refusal,
    RunStatus,
    Segment,
    Weights,
    Welcome,
)


def array(data: object, shape: object, dtype: object = "<f4") -> dict[str, Any]:
    """Return an array as it is on the wire."""
    return {"dtype": dtype, "shape": shape, "data": data}


def field(kind: type, name: str, value: object, expected: str, part: str = "") -> Any:
    """Make a row of the table below: a field of the example has a wrong value."""
    subject = f"{kind.__name__}.{name}{part}"
    found = f"{re.escape(subject)}: found .*, expected {re.escape(expected)}"
    return pytest.param(altered(kind, **{name: value}), found, id=f"{subject}={value!r:.40}")


def reward(value: object, part: str, expected: str) -> Any:
    """Make a row with a wrong array."""
    return field(Segment, "reward", value, expected, part)


def message(kind: type, reason: str, /, **changes: object) -> Any:
    """Make a row: an example with changes."""
    return pytest.param(altered(kind, **changes), reason, id=f"{kind.__name__} {changes!r:.40}")


def unread(payload: bytes, reason: str) -> Any:
    """Make a row: bytes that are not msgpack, or too much of it."""
    reason = rf".*: not msgpack \(.*{re.escape(reason)}.*\)"
    return pytest.param(payload, reason, id=repr(payload[:9]))


VERDICTS = "one of ('accepted', 'duplicate', 'stale', 'refused', 'unknown')"
MAP = "an array map of dtype, shape and data"
FITS = "at most two sizes that fit data"
INTEGER = "an integer below 2^63"
NO_ARRAYS: list[Any] = [[1.0], None, {"dtype": "<f4", "shape": [1]}]
NO_KINDS: list[Any] = ["Spaces", "Message", "", None, 3, ["Ack"], {}]  # Spaces is only a part
PASSED_OVER = b"\x85" + altered(Refusal)[1:] + b"\xa6colour"
MALFORMED = [
    field(Ack, "verdict", "maybe", VERDICTS),
    field(Ack, "verdict", ["accepted"], VERDICTS),
    field(Welcome, "clock", "turn-based", "one of ('lockstep', 'async')"),
    field(Ack, "reason", b"bytes", "str"),
    field(Segment, "actor", None, "str"),
    field(Hello, "cause", None, "str"),
    field(Weights, "graph", "text", "bytes"),
    field(Segment, "terminated", 1, "bool"),
    *(field(Ack, "wait_s", value, "a number") for value in ("1", True, None)),
    *(field(Ack, "generation", value, INTEGER) for value in (1.0, True, msgpack.ExtType(5, b"x"))),
    *(field(Segment, name, 2**63, INTEGER) for name in ("seq", "generation", "episode_length")),
    field(Hello, "slot", 0.0, INTEGER),
    field(RunStatus, "actors", {}, "an array"),
    field(RunStatus, "actors", "ab", "an array"),
    field(Segment, "metrics", None, "an array"),
    field(Segment, "metrics", {"is_success": 1.0}, "an array"),
    *(reward(value, "", MAP) for value in NO_ARRAYS),
    reward({**array(bytes(4), [1]), "order": "F"}, "", MAP),
    *(reward(array(bytes(8), [1], t), ": dtype", "'<f4'") for t in (">f4", "<f8", "|O", None)),
    *(reward(array(data, [1]), ": data", "bytes") for data in ("text", [0, 0, 0, 0])),
    *(
        reward(array(bytes(4), shape), ": shape", FITS)
        for shape in ([-1], [-1, -1], [5], [1, 1, 1], [1.0], [True], 1, {"0": 1})
    ),
    *(reward(array(b"", shape), ": shape", FITS) for shape in ([2**63, 0], [0, 2**62], [2**32, 1])),
    reward(array(bytes(4), [2]), ": data", "8 bytes"),
    *(reward(array(bytes(size), [1]), ": data", "4 bytes") for size in (3, 8)),
    *(message(Segment, "segment h-1/7: arrays disagree about T: .*", reward=array(bytes(4 * n), s))
      for n, s in ((0, [0]), (1, []), (2, [2]))),
    message(Segment, "segment h-1/7: obs: found nan, .*", obs=array(b"\0\0\xc0\x7f", [1, 1])),
    message(Ack, r"ack: wait_s: found -1.0, expected 0 to 1e\+06 seconds", wait_s=-1),
    message(Hello, r"Spaces: found \[\], expected a map of its fields", spaces=[]),
    message(Welcome, "Spaces: found None, expected a map of its fields", spaces=None),
    message(Welcome, "EnvConfig: found 'E', expected a map of its fields", env="E"),
    message(Welcome, r"EnvConfig: missing fields \['env_id'\]", env={}),
    message(Segment, r"EpisodeMetric: missing fields \['value'\]", metrics=[{"name": "x"}]),
    message(Weights, r"Notice: missing fields \['generation'.*", notice={"version": 1}),
    message(RunStatus, r"ActorStatus: missing fields \['slot'.*", actors=[{"actor": "a"}]),
    *(
        message(Ack, f"kind: found {re.escape(repr(kind))}, expected .*", kind=kind)
        for kind in NO_KINDS
    ),
    unread(b"", "incomplete input"),
    unread(b"\xc1", "a byte that begins no value"),
    unread(b"\x91" * 2000, "nested too deeply"),
    unread(b"\xd7\xff" + b"\xff" * 8, ""),  # an impossible timestamp
    *(unread(payload, "") for payload in (b"\x81\x01\x02", b"\x81\x90\x02", b"\x81\xa1\xff\x02")),
    unread(b"\x80\x04\x95\x05\0\0\0\0\0\0\0\x8c\x01a\x94.", ""),  # a pickle
    unread(b'{"a2s": 2, "kind": "Ack"}', ""),
    # An extension, bytes, a text, a map and an array of four gigabytes.
    *(unread(bytes([code]) + b"\xff\xff\xff\xff\5", "") for code in b"\xc9\xc6\xdb\xdf\xdd"),
    unread(b"\x81\xa3a2s\xdd\xff\xff\xff\xff", "array_len"),
    # What is passed over is unpacked all the same.
    unread(PASSED_OVER + b"\x91" * 2000 + b"\xc0", "nested too deeply"),
    unread(PASSED_OVER + b"\xdc\x40\0" + b"\x80" * (1 << 14), "exceeds max_array_len(8192)"),
    unread(PASSED_OVER + b"\xa1\xff", "invalid start byte"),
    pytest.param(b"\xc0", ".*: found NoneType, expected a map", id="nil"),
    pytest.param(b"\x90", ".*: found list, expected a map", id="array"),
    pytest.param(b"\x80", "peer speaks protocol None, this is 2", id="another program's map"),
    pytest.param(b"\x82\xa3a2s\2\xc4\4kind\xa3Ack", "kind: found None, .*", id="key is bytes"),
]  # fmt: skip


@pytest.mark.parametrize(("payload", "reason"), MALFORMED)
def test_what_is_no_message_is_refused_with_the_reason(payload: bytes, reason: str) -> None:
    """Nothing is converted, and whatever could be too large is checked before it is made."""
    assert re.fullmatch(reason, refusal_of(payload))


def test_a_message_of_another_kind_is_refused() -> None:
    """Only what was asked for is made."""
    reason = refusal_of(EXAMPLES[Notice][1], Ack, Refusal)
    assert reason == "kind: found 'Notice', expected Ack or Refusal"


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_or_extended_payload_is_malformed(kind: type) -> None:
    """Every proper prefix is refused, and so is a payload with something after it."""
    payload = EXAMPLES[kind][1]
    for end in range(len(payload)):
        refusal_of(payload[:end], kind)
    assert "extra data" in refusal_of(payload + b"\xc0", kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_payload_over_the_limit_of_its_kind_is_refused_unread(kind: type) -> None:
    """The size is looked at first, so zeros that are no message still fail for their size."""
    limit = MAX_BYTES[kind]
    reason = f"^{kind.__name__}: found {limit + 1} bytes, expected at most {limit}$"
    with pytest.raises(OversizeMessageError, match=reason):
        decode(bytes(limit + 1), kind)


def test_a_message_over_the_limit_is_not_sent() -> None:
    """The sender is told, rather than the receiver's answer waited for."""
    with pytest.raises(OversizeMessageError, match="expected at most 1048576"):
        encode(Refusal(reason="x" * MIB))


@pytest.mark.parametrize("version", [0, 1, 3, -1, True, 2.0, "2", None, [2]])
def test_another_major_version_is_refused(version: Any) -> None:
    """Nothing else of such a message is read."""
    reason = re.escape(f"peer speaks protocol {version!r}, this is 2")
    with pytest.raises(SchemaMismatchError, match=f"^{reason}$"):
        decode(altered(Ack, a2s=version, kind="Future", colour="red"), Ack)


@pytest.mark.parametrize("depth", [10, 400, 990, 1020, 5000, 500_000])
@pytest.mark.parametrize("level", [b"\x91", b"\x81\xa1k"], ids=["arrays", "maps"])
@pytest.mark.parametrize("field", ["a2s", "kind", "actor", "num_envs", "spaces"])
def test_deep_nesting_is_refused(field: str, level: bytes, depth: int) -> None:
    """Neither unpacking nor the reason's text may run out of stack."""
    payload = bytes([0x80 + len(body_of(Hello))])
    for name, value in body_of(Hello).items():
        deep = level * depth + b"\xc0"
        payload += msgpack.packb(name) + (deep if name == field else msgpack.packb(value))
    refusal_of(payload, Hello)


@pytest.mark.parametrize("value", [b"\x80", b"\x90", b"\xc0", b"\x01"], ids=repr)
def test_a_payload_of_nothing_but_tiny_values_is_refused_before_one_is_made(value: bytes) -> None:
    """Sixteen megabytes would become more than a gigabyte of Python objects."""
    count = MAX_BYTES[Segment] - 5
    payload = b"\xdd" + count.to_bytes(4, "big") + value * count
    tracemalloc.start()
    reason = refusal_of(payload, Segment)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert reason == "Segment: not msgpack (more than 16384 values)"
    assert most < MIB


@pytest.mark.parametrize("size", [9000, 100_000])
def test_what_is_announced_and_not_sent_is_refused(size: int) -> None:
    """Nested arrays would get their memory before what they hold."""
    reason = refusal_of((b"\xdc" + (8193).to_bytes(2, "big")) * 1000 + bytes(size), Segment)
    assert re.search("exceeds max_array_len|more than 16384 values", reason)


def test_every_value_of_msgpack_is_counted_once() -> None:
    """As msgpack itself finds it, one more than may be is too many."""
    kinds = [
        None, True, False, 1, 200, 1 << 12, 1 << 20, 1 << 40, -1, -200, -5000, -(1 << 20),
        -(1 << 40), 0.5, "a", "b" * 99, "c" * 300, "d" * 70_000, b"e", b"f" * 300, b"g" * 70_000,
        [1] * 3, [2] * 99, [3] * 70_000, {"h": 4}, {str(i): i for i in range(99)}, {},
        {str(i): i for i in range(70_000)}, msgpack.Timestamp(1, 1),
        *(msgpack.ExtType(5, bytes(n)) for n in (1, 2, 4, 8, 16, 17, 300, 70_000)),
    ]  # fmt: skip
    held = 3 + 99 + 70_000 + 2 + 198 + 140_000
    payload = msgpack.packb(kinds)
    assert not has_too_many_values(payload, 1 + len(kinds) + held)
    assert has_too_many_values(payload, len(kinds) + held)
    assert msgpack.unpackb(payload) == kinds


def test_a_status_of_a_run_with_the_most_actors_can_be_read() -> None:
    status = altered(RunStatus, actors=[body_of(ActorStatus)] * 4096)
    assert len(decode(status, RunStatus).actors) == 4096


@pytest.mark.parametrize("field", ["a2s", "kind", "actor", "num_envs", "spaces"])
def test_the_reason_stays_short_whatever_was_found(field: str) -> None:
    """It goes into answers and logs."""
    for found in ("x\n" * 300_000, b"x" * 600_000, [[1] * 9] * 9, {"k" * 300_000: 1}):
        refusal_of(altered(Hello, **{field: found}), Hello)
