"""Messages to bytes and back, and everything that is not a message."""

import json
import struct
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from a2s.protocol.codec import (
    MAX_BYTES,
    MIB,
    SCHEMA_VERSION,
    Message,
    decode,
    encode,
    refuse_major_1,
)
from a2s.protocol.env_config import TIMEOUT_S, EnvConfig
from a2s.protocol.errors import (
    MalformedMessageError,
    OversizeMessageError,
    SchemaMismatchError,
)
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    EpisodeMetric,
    Hello,
    Notice,
    RecoveryEvent,
    Refusal,
    RunStatus,
    Segment,
    Weights,
    Welcome,
)
from a2s.protocol.replay_messages import COLUMNS, ReplayInfo, ReplayRequest, ReplaySample

KINDS = get_args(Message)

# Every byte is written by hand, field by field: a fix* header carries its own size
# (\x8N map, \x9N array, \xaN str), \xcb is a float64, \xc4 a bin of up to 255 bytes.
# What has a default comes after what has none, and apart from it.
F4_1 = b"\x83\xa5dtype\xa3<f4\xa5shape\x91\x01\xa4data\xc4\x04"  # a float32 [1] follows
F4_1_1 = b"\x83\xa5dtype\xa3<f4\xa5shape\x92\x01\x01\xa4data\xc4\x04"  # a float32 [1, 1] follows
ONE, MINUS_ONE, HALF = b"\x00\x00\x80\x3f", b"\x00\x00\x80\xbf", b"\x00\x00\x00\x3f"
FLOAT64_HALF = b"\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00"


def f32(values: object) -> Array:
    """Make a float32 array."""
    return np.array(values, np.float32)


SPACES = Spaces(obs_size=1, action_low=f32([-1]), action_high=f32([1]))
SPACES_FIELDS = (
    b"\xa8obs_size\x01\xaaaction_low" + F4_1 + MINUS_ONE + b"\xabaction_high" + F4_1 + ONE
)
SPACES_BYTES = b"\x84" + SPACES_FIELDS + b"\xaaobs_offset\xc0"
OFFSET_BYTES = b"\x84" + SPACES_FIELDS + b"\xaaobs_offset" + F4_1 + HALF
ENV = EnvConfig(
    env_id="E",
    kwargs='{"n":1}',
    wrappers=("m:C",),
    action_repeat=2,
    frame_stack=3,
    max_episode_steps=1000,
    timeout_s=0.5,
    info_metrics=("x",),
)
ENV_FIELDS = b"\xa6env_id\xa1E"
ENV_BYTES = (
    b"\x88" + ENV_FIELDS + b'\xa6kwargs\xa7{"n":1}\xa8wrappers\x91\xa3m:C\xadaction_repeat\x02'
    b"\xabframe_stack\x03\xb1max_episode_steps\xcd\x03\xe8\xa9timeout_s" + FLOAT64_HALF +
    b"\xacinfo_metrics\x91\xa1x"
)  # fmt: skip
NOTICE = Notice(
    generation=1, epoch=0, version=2, quota_steps=300, quota_episodes=0, num_bytes=2, sha256="ab"
)
NOTICE_FIELDS = (
    b"\xaageneration\x01\xa5epoch\x00\xa7version\x02\xabquota_steps\xcd\x01\x2c"
    b"\xaequota_episodes\x00\xa9num_bytes\x02\xa6sha256\xa2ab"
)
HELLO = Hello(actor="h-1", num_envs=2, env_id="E", spaces=SPACES)
HELLO_FIELDS = b"\xa5actor\xa3h-1\xa8num_envs\x02\xa6env_id\xa1E\xa6spaces"
WELCOME = Welcome(
    run="r",
    generation=1,
    env_id="E",
    spaces=SPACES,
    num_envs=8,
    clock="lockstep",
    slot=-1,
    seed=65536,
)
WELCOME_FIELDS = b"\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E\xa6spaces"
MORE_WELCOME_FIELDS = (
    b"\xa8num_envs\x08\xa5clock\xa8lockstep\xa4slot\xff\xa4seed\xce\x00\x01\x00\x00"
)
SEGMENT = Segment(
    actor="h-1",
    seq=7,
    generation=1,
    epoch=0,
    weights_version=2,
    env=0,
    obs=f32([[1]]),
    suggestion=f32([[0.5]]),
    log_prob=f32([-1]),
    reward=f32([1]),
    final_obs=f32([0.5]),
    terminated=True,
    truncated=False,
    episode_return=0.5,
    episode_length=1,
)
SEGMENT_FIELDS = (
    b"\xa5actor\xa3h-1\xa3seq\x07\xaageneration\x01\xa5epoch\x00\xafweights_version\x02"
    b"\xa3env\x00\xa3obs" + F4_1_1 + ONE + b"\xaasuggestion" + F4_1_1 + HALF +
    b"\xa8log_prob" + F4_1 + MINUS_ONE + b"\xa6reward" + F4_1 + ONE +
    b"\xa9final_obs" + F4_1 + HALF +
    b"\xaaterminated\xc3\xa9truncated\xc2"
    b"\xaeepisode_return" + FLOAT64_HALF + b"\xaeepisode_length\x01"
)  # fmt: skip
ACTOR_STATUS = ActorStatus(
    actor="h-1",
    slot=0,
    weights_version=2,
    epoch=0,
    env_steps=128,
    episodes=1,
    segments_sent=3,
    segments_answered=2,
    spooled_steps=5,
    leaving=True,
)
ACTOR_STATUS_FIELDS = (
    b"\xa5actor\xa3h-1\xa4slot\x00\xafweights_version\x02\xa5epoch\x00\xa9env_steps\xcc\x80"
    b"\xa8episodes\x01\xadsegments_sent\x03\xb1segments_answered\x02\xadspooled_steps\x05"
    b"\xa7leaving\xc3"
)
TROUBLE = replace(ACTOR_STATUS, doing="d", dropped_steps=4, trouble="t")
TROUBLE_FIELDS = ACTOR_STATUS_FIELDS + b"\xa5doing\xa1d\xaddropped_steps\x04\xa7trouble\xa1t"
RUN_STATUS = RunStatus(
    run="r",
    generation=1,
    env_id="E",
    env_steps=2,
    total_steps=3,
    episodes=4,
    updates=5,
    weights_version=6,
    epoch=7,
    return_mean=0.5,
    env_steps_per_s=0.5,
    waiting_for="",
    actors=(ACTOR_STATUS,),
)
RUN_STATUS_FIELDS = (
    b"\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E"
    b"\xa9env_steps\x02\xabtotal_steps\x03\xa8episodes\x04\xa7updates\x05"
    b"\xafweights_version\x06\xa5epoch\x07\xabreturn_mean" + FLOAT64_HALF +
    b"\xafenv_steps_per_s" + FLOAT64_HALF + b"\xabwaiting_for\xa0\xa6actors"
)  # fmt: skip
REPLAY_INFO = ReplayInfo(
    run="r", generation=1, env_id="E", spaces=SPACES, capacity=9, begin=2, end=3
)
REPLAY_INFO_FIELDS = b"\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E\xa6spaces"
MORE_REPLAY_INFO_FIELDS = b"\xa8capacity\x09\xa5begin\x02\xa3end\x03"

# Whole messages, as they were in the first release of this major version.
GOLDEN: list[tuple[Message, bytes]] = [
    (
        replace(HELLO, cause="c", slot=1),
        b"\x88\xa3a2s\x02\xa4kind\xa5Hello" + HELLO_FIELDS + SPACES_BYTES +
        b"\xa5cause\xa1c\xa4slot\x01",
    ),
    (
        Hello(actor="h-1", num_envs=0, env_id="", spaces=None),
        b"\x88\xa3a2s\x02\xa4kind\xa5Hello"
        b"\xa5actor\xa3h-1\xa8num_envs\x00\xa6env_id\xa0\xa6spaces\xc0\xa5cause\xa0\xa4slot\xff",
    ),
    (
        replace(WELCOME, spaces=replace(SPACES, obs_offset=f32([0.5])), env=ENV),
        b"\x8b\xa3a2s\x02\xa4kind\xa7Welcome" + WELCOME_FIELDS + OFFSET_BYTES +
        MORE_WELCOME_FIELDS + b"\xa3env" + ENV_BYTES,
    ),
    (
        WELCOME,
        b"\x8b\xa3a2s\x02\xa4kind\xa7Welcome" + WELCOME_FIELDS + SPACES_BYTES +
        MORE_WELCOME_FIELDS + b"\xa3env\xc0",
    ),
    (Refusal(reason="no"), b"\x83\xa3a2s\x02\xa4kind\xa7Refusal\xa6reason\xa2no"),
    (
        replace(SEGMENT, metrics=(EpisodeMetric(name="is_success", value=0.5),)),
        b"\xde\x00\x12\xa3a2s\x02\xa4kind\xa7Segment" + SEGMENT_FIELDS +  # 18 entries: a map 16
        b"\xa7metrics\x91\x82\xa4name\xaais_success\xa5value" + FLOAT64_HALF,
    ),
    (
        Ack(
            verdict="accepted", reason="", generation=1, epoch=0, weights_version=2, wait_s=0.5
        ),
        b"\x88\xa3a2s\x02\xa4kind\xa3Ack\xa7verdict\xa8accepted\xa6reason\xa0"
        b"\xaageneration\x01\xa5epoch\x00\xafweights_version\x02\xa6wait_s" + FLOAT64_HALF,
    ),
    (NOTICE, b"\x89\xa3a2s\x02\xa4kind\xa6Notice" + NOTICE_FIELDS),
    (
        Weights(notice=NOTICE, graph=b"\x00\xff"),
        b"\x84\xa3a2s\x02\xa4kind\xa7Weights"
        b"\xa6notice\x87" + NOTICE_FIELDS + b"\xa5graph\xc4\x02\x00\xff",
    ),
    (
        RecoveryEvent(
            id=1,
            generation=1,
            epoch=2,
            draw=0.5,
            probability=0.5,
            r=0.5,
            r_best=0.5,
            restored_version=3,
            weights_version=4,
        ),
        b"\x8b\xa3a2s\x02\xa4kind\xadRecoveryEvent\xa2id\x01\xaageneration\x01\xa5epoch\x02"
        b"\xa4draw" + FLOAT64_HALF + b"\xabprobability" + FLOAT64_HALF +
        b"\xa1r" + FLOAT64_HALF + b"\xa6r_best" + FLOAT64_HALF +
        b"\xb0restored_version\x03\xafweights_version\x04",
    ),
    (TROUBLE, b"\x8f\xa3a2s\x02\xa4kind\xabActorStatus" + TROUBLE_FIELDS),
    (
        replace(RUN_STATUS, actors=(TROUBLE,)),
        b"\x8f\xa3a2s\x02\xa4kind\xa9RunStatus" + RUN_STATUS_FIELDS + b"\x91\x8d" + TROUBLE_FIELDS,
    ),
    (
        REPLAY_INFO,
        b"\x89\xa3a2s\x02\xa4kind\xaaReplayInfo" + REPLAY_INFO_FIELDS + SPACES_BYTES +
        MORE_REPLAY_INFO_FIELDS,
    ),
    (
        ReplayRequest(
            batch_size=1, seed=2, n_step=3, gamma=0.5, prioritised=True, beta=0.5,
            fields=("obs", "row"),
        ),
        b"\x89\xa3a2s\x02\xa4kind\xadReplayRequest\xaabatch_size\x01\xa4seed\x02"
        b"\xa6n_step\x03\xa5gamma" + FLOAT64_HALF + b"\xabprioritised\xc3"
        b"\xa4beta" + FLOAT64_HALF + b"\xa6fields\x92\xa3obs\xa3row",
    ),
    (
        ReplaySample(
            begin=0, end=5, obs=f32([[0.5]]), action=None, reward=f32([1]), next_obs=None,
            discount=None, weight=None, row=(4,),
        ),
        b"\x8b\xa3a2s\x02\xa4kind\xacReplaySample\xa5begin\x00\xa3end\x05"
        b"\xa3obs" + F4_1_1 + HALF + b"\xa6action\xc0\xa6reward" + F4_1 + ONE +
        b"\xa8next_obs\xc0\xa8discount\xc0\xa6weight\xc0\xa3row\x91\x04",
    ),
]  # fmt: skip

# The same where fields have defaults, with none of these on the wire.
BARE: list[tuple[Message, bytes]] = [
    (HELLO, b"\x86\xa3a2s\x02\xa4kind\xa5Hello" + HELLO_FIELDS + b"\x83" + SPACES_FIELDS),
    (
        replace(WELCOME, env=EnvConfig(env_id="E")),
        b"\x8b\xa3a2s\x02\xa4kind\xa7Welcome" + WELCOME_FIELDS + b"\x83" + SPACES_FIELDS +
        MORE_WELCOME_FIELDS + b"\xa3env\x81" + ENV_FIELDS,
    ),
    (
        WELCOME,
        b"\x8a\xa3a2s\x02\xa4kind\xa7Welcome" + WELCOME_FIELDS + b"\x83" + SPACES_FIELDS +
        MORE_WELCOME_FIELDS,
    ),
    (SEGMENT, b"\xde\x00\x11\xa3a2s\x02\xa4kind\xa7Segment" + SEGMENT_FIELDS),
    (ACTOR_STATUS, b"\x8c\xa3a2s\x02\xa4kind\xabActorStatus" + ACTOR_STATUS_FIELDS),
    (
        RUN_STATUS,
        b"\x8f\xa3a2s\x02\xa4kind\xa9RunStatus" + RUN_STATUS_FIELDS + b"\x91\x8a" +
        ACTOR_STATUS_FIELDS,
    ),
    (
        REPLAY_INFO,
        b"\x89\xa3a2s\x02\xa4kind\xaaReplayInfo" + REPLAY_INFO_FIELDS + b"\x83" + SPACES_FIELDS +
        MORE_REPLAY_INFO_FIELDS,
    ),
]  # fmt: skip

names = st.builds(str.__add__, st.sampled_from("aZ0_"), st.text("abcXYZ019_.-", max_size=95))
texts = st.text(st.characters(codec="utf-8"), max_size=20)
labels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=96).filter(str.isprintable)
counts = st.integers(0, 2**63 - 1)
integers = st.integers(-(2**63), 2**63 - 1)
numbers = st.floats()  # NaN too: a mean of no episodes
sizes = st.integers(1, 4)


def floats32(*shape: int, most: float = 2.0**99) -> st.SearchStrategy[np.ndarray]:
    """Make finite float32 arrays of a shape."""
    return hnp.arrays("<f4", shape, elements=st.floats(-most, most, width=32))


@st.composite
def spaces(draw: st.DrawFn) -> Spaces:
    """Make bounds where the lower one is lower, with an offset or without."""
    low, offset = draw(floats32(draw(sizes))), draw(st.none() | floats32(draw(sizes)))
    return Spaces(
        obs_size=draw(st.integers(1, 2**32)) if offset is None else offset.size,
        action_low=low,
        action_high=np.abs(low) * np.float32(2) + np.float32(1),
        obs_offset=offset,
    )


metrics = st.builds(
    EpisodeMetric, name=labels, value=st.floats(allow_nan=False, allow_infinity=False)
)


@st.composite
def segments(draw: st.DrawFn) -> Segment:
    """Make segments whose arrays agree."""
    t, d, a = draw(sizes), draw(sizes), draw(sizes)
    end = draw(st.sampled_from([(False, False), (True, False), (False, True)]))
    return Segment(
        actor=draw(names),
        seq=draw(counts),
        generation=draw(counts),
        epoch=draw(counts),
        weights_version=draw(counts),
        env=draw(counts),
        obs=draw(floats32(t, d, most=2.0**33)),
        suggestion=draw(floats32(t, a, most=2.0**19)),
        log_prob=draw(floats32(t, most=2.0**19)),
        reward=draw(floats32(t, most=2.0**33)),
        final_obs=draw(floats32(d, most=2.0**33)),
        terminated=end[0],
        truncated=end[1],
        episode_return=draw(st.floats(-1e10, 1e10)),
        episode_length=draw(st.integers(t, 2**63 - 1)),
        metrics=tuple(draw(st.lists(metrics, max_size=3))),
    )


@st.composite
def samples(draw: st.DrawFn) -> ReplaySample:
    """Make samples whose columns agree, with some of them missing."""
    b, d, a = draw(sizes), draw(sizes), draw(sizes)
    shapes = {"obs": (b, d), "action": (b, a), "next_obs": (b, d)}
    columns = {
        name: draw(st.none() | floats32(*shapes.get(name, (b,))))
        for name in ("obs", "action", "next_obs", "discount", "weight")
    }
    return ReplaySample(
        begin=draw(integers),
        end=draw(integers),
        reward=draw(floats32(b)),
        row=tuple(draw(st.just([]) | st.lists(integers, min_size=b, max_size=b))),
        **columns,
    )


asking = st.builds(Hello, actor=names, num_envs=st.just(0), env_id=st.just(""), spaces=st.none())
joining = st.builds(
    Hello,
    actor=names,
    num_envs=st.integers(1, 4096),
    env_id=texts.filter(bool),
    spaces=spaces(),
    cause=texts,
    slot=st.integers(-1, 999_999),
)
environments = st.builds(
    EnvConfig,
    env_id=texts.filter(bool),
    kwargs=st.dictionaries(texts, texts | numbers | st.lists(integers, max_size=2), max_size=3).map(
        json.dumps
    ),
    wrappers=st.lists(texts, max_size=3).map(tuple),
    action_repeat=st.integers(1, 2**31 - 1),
    frame_stack=st.integers(1, 2**31 - 1),
    max_episode_steps=st.integers(0, 2**31 - 1),
    timeout_s=st.floats(0.0, exclude_min=True, allow_infinity=False),
    info_metrics=st.lists(labels, max_size=3).map(tuple),
)
notices = st.builds(
    Notice,
    generation=integers,
    epoch=integers,
    version=integers,
    quota_steps=counts.filter(bool),
    quota_episodes=integers,
    num_bytes=integers,
    sha256=texts,
)
statuses = st.builds(
    ActorStatus,
    actor=names,
    slot=integers,
    weights_version=integers,
    epoch=integers,
    env_steps=integers,
    episodes=integers,
    segments_sent=integers,
    segments_answered=integers,
    spooled_steps=integers,
    leaving=st.booleans(),
    doing=texts,
    dropped_steps=integers,
    trouble=texts,
)
ANY_MESSAGE: dict[type, st.SearchStrategy[Message]] = {
    Hello: asking | joining,
    Welcome: st.builds(
        Welcome,
        run=texts,
        generation=integers,
        env_id=texts,
        spaces=spaces(),
        num_envs=integers,
        clock=st.sampled_from(["lockstep", "async"]),
        slot=integers,
        seed=integers,
        env=st.none() | environments,
    ),
    Refusal: st.builds(Refusal, reason=texts),
    Segment: segments(),
    Ack: st.builds(
        Ack,
        verdict=st.sampled_from(["accepted", "duplicate", "stale", "refused"]),
        reason=texts,
        generation=integers,
        epoch=integers,
        weights_version=integers,
        wait_s=st.floats(0, allow_infinity=False),
    ),
    Notice: notices,
    Weights: st.builds(Weights, notice=notices, graph=st.binary(max_size=300)),
    RecoveryEvent: st.builds(
        RecoveryEvent,
        id=integers,
        generation=integers,
        epoch=integers,
        draw=numbers,
        probability=numbers,
        r=numbers,
        r_best=numbers,
        restored_version=integers,
        weights_version=integers,
    ),
    ActorStatus: statuses,
    RunStatus: st.builds(
        RunStatus,
        run=texts,
        generation=integers,
        env_id=texts,
        env_steps=integers,
        total_steps=integers,
        episodes=integers,
        updates=integers,
        weights_version=integers,
        epoch=integers,
        return_mean=numbers,
        env_steps_per_s=numbers,
        waiting_for=texts,
        actors=st.lists(statuses, max_size=3).map(tuple),
    ),
    ReplayInfo: st.builds(
        ReplayInfo,
        run=texts,
        generation=integers,
        env_id=texts,
        spaces=spaces(),
        capacity=integers,
        begin=integers,
        end=integers,
    ),
    ReplayRequest: st.builds(
        ReplayRequest,
        batch_size=st.integers(1, 4096),
        seed=counts,
        n_step=st.integers(1, 64),
        gamma=st.floats(0.0, 1.0),
        prioritised=st.booleans(),
        beta=st.floats(0.0, 1.0),
        fields=st.lists(st.sampled_from(COLUMNS), min_size=1, unique=True).map(tuple),
    ),
    ReplaySample: samples(),
}
anything = st.recursive(
    st.none() | st.booleans() | integers | numbers | texts | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)


def plain(value: Any) -> Any:
    """Turn a message into nested tuples that compare by type and value."""
    if is_dataclass(value):
        return (type(value), *((f.name, plain(getattr(value, f.name))) for f in fields(value)))
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    return (type(value), repr(value))  # repr: NaN equals itself


def refusal_of(payload: bytes, *kinds: type) -> str:
    """Decode something that is malformed; return the reason, which an operator can read."""
    with pytest.raises(MalformedMessageError) as caught:
        decode(payload, *kinds or KINDS)
    reason = str(caught.value)
    assert reason
    assert len(reason.splitlines()) == 1
    assert len(reason) < 500
    return reason


def body_of(kind: type) -> dict[str, Any]:
    """Return the map that the golden message of a kind is on the wire."""
    body: dict[str, Any] = msgpack.unpackb(next(b for m, b in GOLDEN if type(m) is kind))
    return body


def altered(kind: type, /, **changes: Any) -> bytes:
    """Pack the golden message of a kind with some entries changed."""
    payload: bytes = msgpack.packb(body_of(kind) | changes)
    return payload


def required(kind: type) -> list[str]:
    """Name the fields of a kind that have no default."""
    return [f.name for f in fields(kind) if f.default is MISSING]


def without_news(found: Any, golden: Any) -> Any:
    """Leave out of maps what was added at their end since the golden ones were written."""
    if isinstance(golden, dict):
        assert list(found)[: len(golden)] == list(golden)
        return {key: without_news(found[key], golden[key]) for key in golden}
    if isinstance(golden, list):
        return [without_news(a, b) for a, b in zip(found, golden, strict=True)]
    return found


def array(data: bytes, shape: Any, dtype: Any = "<f4") -> dict[str, Any]:
    """Return an array as it is on the wire."""
    return {"dtype": dtype, "shape": shape, "data": data}


def test_there_is_a_golden_message_a_strategy_and_a_limit_for_every_kind() -> None:
    """A new kind cannot be forgotten here."""
    assert {type(m) for m, _ in GOLDEN} == set(ANY_MESSAGE) == set(MAX_BYTES) == set(KINDS)


@pytest.mark.parametrize(("message", "payload"), GOLDEN)
def test_the_bytes_of_a_message_never_change(message: Message, payload: bytes) -> None:
    """Actors of another language or release read them; but fields may be added at the end."""
    assert SCHEMA_VERSION == 2
    found = msgpack.unpackb(encode(message))
    assert msgpack.packb(without_news(found, msgpack.unpackb(payload))) == payload
    assert plain(decode(payload, type(message))) == plain(message)


@pytest.mark.parametrize(("message", "payload"), BARE)
def test_what_has_a_default_need_not_be_there(message: Message, payload: bytes) -> None:
    """Without a default, what is added later would make all who were there before unreadable."""
    assert plain(decode(payload, type(message))) == plain(message)


def test_all_that_has_defaults_is_tried_without_them() -> None:
    """A field with a default that is added to another message is first left out above."""
    kinds = {kind for kind in KINDS if len(required(kind)) < len(fields(kind))}
    assert kinds <= {type(message) for message, _ in BARE}


def test_the_defaults_mean_what_was_so_before_there_was_the_field() -> None:
    """Who leaves one out has a meaning, and it never changes."""
    assert SPACES.obs_offset is None
    assert (HELLO.cause, HELLO.slot, WELCOME.env, SEGMENT.metrics) == ("", -1, None, ())
    assert (ACTOR_STATUS.doing, ACTOR_STATUS.dropped_steps, ACTOR_STATUS.trouble) == ("", 0, "")
    found = plain(EnvConfig(env_id="E"))
    assert found == plain(
        EnvConfig(
            env_id="E",
            kwargs="{}",
            wrappers=(),
            action_repeat=1,
            frame_stack=1,
            max_episode_steps=0,
            timeout_s=120.0,
            info_metrics=(),
        )
    )
    assert TIMEOUT_S == 120.0


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_every_message_survives_the_round_trip(kind: type, data: st.DataObject) -> None:
    """Types, values, shapes and every bit of the arrays; also when other kinds are expected."""
    message = data.draw(ANY_MESSAGE[kind])
    assert plain(decode(encode(message), kind)) == plain(message)
    assert plain(decode(encode(message), *KINDS)) == plain(message)


def test_the_largest_observations_have_room_in_a_welcome() -> None:
    """Otherwise the learner could not answer, and its actors would ask for ever."""
    spaces = replace(SPACES, obs_size=1_000_000, obs_offset=np.ones(1_000_000, np.float32))
    env = replace(ENV, kwargs=json.dumps({"n": "x" * 900_000}))
    for message in (replace(WELCOME, spaces=spaces, env=env), replace(REPLAY_INFO, spaces=spaces)):
        found: Any = decode(encode(message), type(message))
        assert plain(found) == plain(message)


def test_arrays_of_any_layout_are_sent_as_little_endian_float32_in_c_order() -> None:
    """A view, a transpose or a float64 array is the sender's business."""
    obs: Any = np.arange(12, dtype=">f8").reshape(3, 4).T[::2]  # [2, 3]
    message = Segment(
        actor="a",
        seq=0,
        generation=0,
        epoch=0,
        weights_version=0,
        env=0,
        obs=obs,
        suggestion=np.zeros((2, 1), np.float32),
        log_prob=np.zeros(2, np.float32),
        reward=np.zeros(2, np.float32),
        final_obs=np.zeros(3, np.float32),
        terminated=False,
        truncated=False,
        episode_return=0.0,
        episode_length=2,
    )
    found = decode(encode(message), Segment).obs
    assert found.dtype == np.dtype("<f4")
    assert found.tolist() == [[0.0, 4.0, 8.0], [2.0, 6.0, 10.0]]


def test_decoded_arrays_cannot_be_changed() -> None:
    """A message is immutable, its arrays included."""
    segment = decode(next(b for m, b in GOLDEN if type(m) is Segment), Segment)
    with pytest.raises(ValueError, match="read-only"):
        segment.reward[0] = 1


@settings(deadline=None, max_examples=500)
@given(payload=st.binary(max_size=200))
def test_garbage_is_malformed_and_nothing_else(payload: bytes) -> None:
    """Whatever arrives, a receiver has one exception to handle."""
    refusal_of(payload)


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_or_extended_payload_is_malformed(kind: type) -> None:
    """Every proper prefix is refused, and so is a payload with something after it."""
    payload = next(b for m, b in GOLDEN if type(m) is kind)
    for end in range(len(payload)):
        refusal_of(payload[:end], kind)
    assert "extra data" in refusal_of(payload + b"\xc0", kind)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_flipped_bytes_and_foreign_values_never_raise_anything_else(
    kind: type, data: st.DataObject
) -> None:
    """Damage may leave a message, but never another exception than MalformedMessageError."""
    payload = bytearray(next(b for m, b in GOLDEN if type(m) is kind))
    for place in data.draw(st.lists(st.integers(0, len(payload) - 1), max_size=3)):
        payload[place] = data.draw(st.integers(0, 255))
    field = data.draw(st.sampled_from(sorted(body_of(kind))))
    for damaged in (bytes(payload), altered(kind, **{field: data.draw(anything)})):
        try:
            decode(damaged, kind)
        except MalformedMessageError:
            refusal_of(damaged, kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_payload_over_the_limit_of_its_kind_is_refused_unread(kind: type) -> None:
    """The size is looked at first, so zeros that are no message still fail for their size."""
    reason = refusal_of(bytes(MAX_BYTES[kind] + 1), kind)
    assert reason == (
        f"{kind.__name__}: found {MAX_BYTES[kind] + 1} bytes, expected at most {MAX_BYTES[kind]}"
    )
    with pytest.raises(OversizeMessageError):
        decode(bytes(MAX_BYTES[kind] + 1), kind)


def test_a_message_over_the_limit_is_not_sent() -> None:
    """The sender is told, rather than the receiver's answer waited for."""
    with pytest.raises(OversizeMessageError, match="expected at most 1048576"):
        encode(Refusal(reason="x" * MIB))


@pytest.mark.parametrize("version", [0, 1, 3, -1, True, 2.0, "2", None, [2]])
def test_another_major_version_is_refused(version: Any) -> None:
    """Nothing else of such a message is read."""
    reason = refusal_of(altered(Ack, a2s=version, kind="Future", colour="red"))
    assert reason == f"peer speaks protocol {version!r}, this is 2"
    with pytest.raises(SchemaMismatchError):
        decode(altered(Ack, a2s=version), Ack)


def test_a_message_without_a_version_is_refused() -> None:
    """Some other program's map."""
    assert "protocol None" in refusal_of(msgpack.packb({"hello": "world"}))


def test_a_message_of_protocol_1_is_refused_for_its_version() -> None:
    """As its actors wrote it: the fields that it lacks are not what is wrong with it."""
    hello = (
        b"\x86\xa3a2s\x01\xa4kind\xa5Hello"
        b"\xa5actor\xa3h-1\xa8num_envs\x00\xa6env_id\xa0\xa6spaces\xc0"
    )
    assert refusal_of(hello, Hello) == "peer speaks protocol 1, this is 2"


def test_an_actor_of_protocol_1_can_read_why_it_is_refused() -> None:
    """It takes version 1 alone, exactly the fields that it knows, and shows the reason."""
    payload = refuse_major_1()
    assert payload.startswith(b"\x83\xa3a2s\x01\xa4kind\xa7Refusal\xa6reason\xd9")  # a str 8
    reason = msgpack.unpackb(payload)["reason"]
    assert reason.startswith("this actor speaks protocol 1, the learner protocol 2: ")
    assert len(reason.splitlines()) == 1
    assert refusal_of(payload) == "peer speaks protocol 1, this is 2"


@pytest.mark.parametrize("found", ["Notice", "Spaces", "Message", "", None, 3, ["Ack"], {}])
def test_another_kind_than_the_expected_is_refused(found: Any) -> None:
    """Spaces is a part of messages, not one."""
    reason = refusal_of(altered(Ack, kind=found), Ack, Refusal)
    assert reason == f"kind: found {found!r}, expected Ack or Refusal"


@pytest.mark.parametrize("kind", KINDS)
def test_each_missing_field_without_a_default_is_named(kind: type) -> None:
    """So that who wrote the sender knows what to add."""
    for name in required(kind):
        body = body_of(kind)
        del body[name]
        reason = refusal_of(msgpack.packb(body), kind)
        assert reason == f"{kind.__name__}: missing fields ['{name}']"
    bare = msgpack.packb({"a2s": 2, "kind": kind.__name__})
    assert refusal_of(bare, kind) == f"{kind.__name__}: missing fields {required(kind)}"


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_field_is_passed_over(kind: type) -> None:
    """Wherever it stands and whatever it holds: a sender of a later release may have it."""
    message: Any = decode(msgpack.packb(body_of(kind)), kind)
    values: list[Any] = ["red", None, {"of": ["what", {}]}, msgpack.ExtType(5, b"x"), [[]] * 99]
    for value in values:
        last = altered(kind, colour=value)
        first = msgpack.packb({"colour": value, **body_of(kind)})
        assert plain(decode(last, kind)) == plain(decode(first, kind)) == plain(message)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        (Hello, ["spaces"]),
        (Welcome, ["spaces"]),
        (Welcome, ["env"]),
        (Segment, ["metrics", 0]),
        (Weights, ["notice"]),
        (RunStatus, ["actors", 0]),
        (ReplayInfo, ["spaces"]),
    ],
)
def test_an_unknown_field_of_a_part_is_passed_over(kind: type, place: list[Any]) -> None:
    """Parts grow as messages do."""
    body = body_of(kind)
    part = body
    for step in place:
        part = part[step]
    part["colour"] = {"red": 1}
    found: Any = decode(msgpack.packb(body), kind)
    expected: Any = decode(msgpack.packb(body_of(kind)), kind)
    assert plain(found) == plain(expected)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        pytest.param(b"\x91" * 2000 + b"\xc0", "nested too deeply", id="deep"),
        pytest.param(
            b"\xdd\x00\x01\x00\x00" + b"\x80" * (1 << 16), "more than 65536 maps", id="many"
        ),
        pytest.param(b"\xdd\xff\xff\xff\xff", "array_len", id="huge"),
        pytest.param(b"\xa1\xff", "invalid start byte", id="not UTF-8"),
    ],
)
def test_what_is_passed_over_is_bounded_too(value: bytes, reason: str) -> None:
    """It is unpacked all the same."""
    payload = b"\x84" + altered(Refusal)[1:] + b"\xa6colour" + value
    assert reason in refusal_of(payload, Refusal)


def test_fields_of_nested_maps_are_checked_as_well() -> None:
    """A notice within weights and a status within a run's status are messages too."""
    notice = {k: v for k, v in body_of(Notice).items() if k not in ("a2s", "kind", "version")}
    assert "missing fields ['version']" in refusal_of(altered(Weights, notice=notice))
    assert "ActorStatus" in refusal_of(altered(RunStatus, actors=[{"actor": "a"}]))
    assert "Spaces" in refusal_of(altered(Welcome, spaces=None))
    assert refusal_of(altered(Welcome, env={})) == "EnvConfig: missing fields ['env_id']"
    assert refusal_of(altered(Segment, metrics=[{"name": "x"}])) == (
        "EpisodeMetric: missing fields ['value']"
    )


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (Ack, "verdict", "maybe"),
        (Ack, "verdict", ["accepted"]),
        (Ack, "reason", b"bytes"),
        (Ack, "generation", 1.0),
        (Ack, "generation", True),
        (Ack, "wait_s", "1"),
        (Ack, "wait_s", True),
        (Ack, "wait_s", None),
        (Welcome, "clock", "turn-based"),
        (Segment, "seq", "7"),
        (Segment, "terminated", 1),
        (Segment, "reward", [1.0]),
        (Segment, "reward", None),
        (Segment, "actor", None),
        (Hello, "spaces", []),
        (Weights, "graph", "text"),
        (RunStatus, "actors", {}),
        (RunStatus, "actors", "ab"),
        (ActorStatus, "leaving", 0),
        (ActorStatus, "env_steps", msgpack.ExtType(5, b"x")),
        (ActorStatus, "doing", None),
        (ActorStatus, "dropped_steps", 1.0),
        (Hello, "cause", None),
        (Hello, "slot", 0.0),
        (Welcome, "env", "Hopper-v5"),
        (Welcome, "env", []),
        (Segment, "metrics", None),
        (Segment, "metrics", {"is_success": 1.0}),
    ],
)
def test_a_wrong_type_is_refused_by_name(kind: type, field: str, value: Any) -> None:
    """Nothing is converted, except an integer where a number is asked for."""
    assert field in refusal_of(altered(kind, **{field: value}), kind).lower()


@pytest.mark.parametrize("field", ["seq", "generation", "episode_length"])
def test_an_integer_that_no_file_has_room_for_is_refused(field: str) -> None:
    """Files of a run have 64 bits with a sign."""
    decode(altered(Segment, **{field: 2**63 - 1}), Segment)
    reason = refusal_of(altered(Segment, **{field: 2**63}))
    assert reason == f"Segment.{field}: found {2**63}, expected an integer below 2^63"


def test_an_integer_is_a_number() -> None:
    """Msgpack libraries of other languages shorten 2.0 to 2."""
    ack = decode(altered(Ack, wait_s=2), Ack)
    assert (type(ack.wait_s), ack.wait_s) == (float, 2.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), -1, -0.5])
def test_an_impossible_wait_is_refused(value: float) -> None:
    """An actor would sleep for it."""
    assert "wait_s" in refusal_of(altered(Ack, wait_s=value))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("field", ["obs", "suggestion", "log_prob", "reward", "final_obs"])
def test_a_non_finite_number_in_a_segment_is_refused(field: str, bad: float) -> None:
    """One NaN reward would end the learning."""
    shape = body_of(Segment)[field]["shape"]
    payload = altered(Segment, **{field: array(struct.pack("<f", bad), shape)})
    reason = refusal_of(payload)
    assert f"segment h-1/7: {field}: found {abs(bad)}, expected at most 1e+" in reason


@pytest.mark.parametrize(
    "value",
    [
        pytest.param(array(bytes(4), [1], ">f4"), id="big-endian"),
        pytest.param(array(bytes(8), [1], "<f8"), id="float64"),
        pytest.param(array(bytes(4), [1], "float32"), id="numpy's name"),
        pytest.param(array(bytes(8), [1], "|O"), id="object"),
        pytest.param(array(bytes(4), [1], None), id="no dtype"),
        pytest.param(array(bytes(4), [-1]), id="negative size"),
        pytest.param(array(bytes(4), [-1, -1]), id="negative sizes with the right product"),
        pytest.param(array(bytes(4), [2]), id="too few bytes"),
        pytest.param(array(bytes(8), [1]), id="too many bytes"),
        pytest.param(array(bytes(3), [1]), id="not whole numbers"),
        pytest.param(array(b"", [0]), id="empty"),
        pytest.param(array(bytes(4), []), id="no dimension"),
        pytest.param(array(bytes(4), [1, 1, 1]), id="three dimensions"),
        pytest.param(array(b"", [2**63, 0]), id="a size beyond int64 and a zero"),
        pytest.param(array(b"", [0, 2**62]), id="a zero and a size beyond memory"),
        pytest.param(array(b"", [2**32, 2**32]), id="a product beyond int64"),
        pytest.param(array(bytes(4), [1.0]), id="size is a float"),
        pytest.param(array(bytes(4), [True]), id="size is a bool"),
        pytest.param(array(bytes(4), 1), id="shape is a number"),
        pytest.param(array(bytes(4), {"0": 1}), id="shape is a map"),
        pytest.param({**array(bytes(4), [1]), "data": "text"}, id="data is text"),
        pytest.param({**array(bytes(4), [1]), "data": [0, 0, 0, 0]}, id="data is an array"),
        pytest.param({"dtype": "<f4", "shape": [1]}, id="no data"),
        pytest.param({**array(bytes(4), [1]), "order": "F"}, id="an unknown entry"),
        pytest.param([0.0], id="a list"),
    ],
)
def test_a_bad_array_is_refused(value: Any) -> None:
    """The one array encoding is checked before numpy sees anything."""
    refusal_of(altered(Segment, reward=value), Segment)


def test_arrays_that_disagree_about_their_length_are_refused() -> None:
    """The reason shows every length."""
    reason = refusal_of(altered(Segment, reward=array(bytes(8), [2])))
    assert reason == (
        "segment h-1/7: arrays disagree about T: found {'obs': 1, 'suggestion': 1, "
        "'log_prob': (1,), 'reward': (2,)}, expected one length"
    )


@pytest.mark.parametrize("depth", [10, 400, 990, 1020, 5000, 500_000])
@pytest.mark.parametrize("level", [b"\x91", b"\x81\xa1k"], ids=["arrays", "maps"])
@pytest.mark.parametrize("field", ["a2s", "kind", "actor", "num_envs", "spaces"])
def test_deep_nesting_is_refused(field: str, level: bytes, depth: int) -> None:
    """Neither unpacking nor the reason's text may run out of stack."""
    payload = b"\x87"
    for name, value in body_of(Hello).items():
        deep = level * depth + b"\xc0"
        payload += msgpack.packb(name) + (deep if name == field else msgpack.packb(value))
    refusal_of(payload, Hello)


@pytest.mark.parametrize(
    "header",
    [
        pytest.param(b"\xdd\xff\xff\xff\xff", id="array"),
        pytest.param(b"\xdf\xff\xff\xff\xff", id="map"),
        pytest.param(b"\xdb\xff\xff\xff\xff", id="text"),
        pytest.param(b"\xc6\xff\xff\xff\xff", id="bytes"),
        pytest.param(b"\xc9\xff\xff\xff\xff\x05", id="extension"),
    ],
)
def test_a_huge_declared_length_is_refused_without_its_memory(header: bytes) -> None:
    """Four gigabytes are promised by five bytes."""
    refusal_of(header)
    refusal_of(header * 100)
    refusal_of(b"\x81\xa3a2s" + header)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xc1", "a byte that begins no value"),
        (b"\x91" * 2000, "nested too deeply"),
        (b"", "Unpack failed: incomplete input"),
    ],
)
def test_the_reason_says_why_bytes_are_not_msgpack(payload: bytes, reason: str) -> None:
    """Some errors of msgpack have no text of their own."""
    assert refusal_of(payload, Ack) == f"Ack: not msgpack ({reason})"


def test_of_a_key_that_comes_twice_the_last_counts() -> None:
    """The first entry may be of any type; it is not looked at."""
    body = altered(Ack, wait_s=2.0)
    header, entries = bytes([body[0] + 1]), body[1:]  # one entry more
    twice = msgpack.packb("wait_s") + msgpack.packb("soon")
    assert decode(header + twice + entries, Ack).wait_s == 2.0
    reason = refusal_of(header + entries + twice, Ack)
    assert reason == "Ack.wait_s: found 'soon', expected a number"


def test_a_payload_of_nothing_but_tiny_maps_is_refused() -> None:
    """Sixteen megabytes would become more than a gigabyte of Python objects."""
    count = MAX_BYTES[Segment] - 5
    payload = b"\xdd" + struct.pack(">I", count) + b"\x80" * count
    assert refusal_of(payload, Segment) == (
        "Segment: not msgpack (more than 65536 maps and arrays)"
    )


@pytest.mark.parametrize("field", ["a2s", "kind", "actor", "num_envs", "spaces"])
def test_the_reason_stays_short_whatever_was_found(field: str) -> None:
    """It goes into answers and logs."""
    for found in ("x\n" * 300_000, b"x" * 600_000, [[1] * 9] * 9, {"k" * 300_000: 1}):
        refusal_of(altered(Hello, **{field: found}), Hello)


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(b"\x81\x01\x02", id="integer key"),
        pytest.param(b"\x81\x90\x02", id="key is an array"),
        pytest.param(b"\x81\xa1\xff\x02", id="key is not UTF-8"),
        pytest.param(b"\x82\xa3a2s\x02\xc4\x04kind\xa3Ack", id="key is bytes"),
        pytest.param(b"\xc1", id="the code that is never used"),
        pytest.param(b"\xd7\xff" + b"\xff" * 8, id="impossible timestamp"),
        pytest.param(b"\xc0", id="nil"),
        pytest.param(b"\x90", id="array"),
        pytest.param(b"", id="nothing"),
        pytest.param(b"\x80\x04\x95\x05\x00\x00\x00\x00\x00\x00\x00\x8c\x01a\x94.", id="a pickle"),
        pytest.param(b'{"a2s": 2, "kind": "Ack"}', id="JSON"),
    ],
)
def test_what_is_not_a_map_of_names_is_refused(payload: bytes) -> None:
    """Other formats included."""
    refusal_of(payload)
