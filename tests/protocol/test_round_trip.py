"""Any message survives the way to bytes and back; any damage is found."""

import json
from collections.abc import Callable
from typing import Any, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from message_examples import EXAMPLES, KINDS, altered, body_of, plain, refusal_of

from a2s.protocol.codec import Message, decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import (
    MODES,
    EvaluatedEpisode,
    EvaluationRequest,
    EvaluationResult,
    EvaluationTask,
)
from a2s.protocol.fields import Spaces
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

names = st.builds(str.__add__, st.sampled_from("aZ0_"), st.text("abcXYZ019_.-", max_size=95))
texts = st.text(st.characters(codec="utf-8"), max_size=20)
labels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=96).filter(str.isprintable)
counts = st.integers(0, 2**63 - 1)
integers = st.integers(-(2**63), 2**63 - 1)
sizes = st.integers(1, 4)
BY_TYPE: dict[type, st.SearchStrategy[Any]] = {
    int: counts, float: st.floats(), str: texts, bool: st.booleans(), bytes: st.binary(),
}  # fmt: skip


def build(kind: Callable[..., Any], **chosen: Any) -> st.SearchStrategy[Any]:
    """Make messages of a kind: of any values that fit the types, except what is chosen here."""
    hints = get_type_hints(kind).items()
    return st.builds(kind, **{name: BY_TYPE[t] for name, t in hints if t in BY_TYPE} | chosen)


def floats32(*shape: int, most: float = 2.0**99) -> st.SearchStrategy[np.ndarray]:
    """Make finite float32 arrays of a shape."""
    return hnp.arrays("<f4", shape, elements=st.floats(-most, most, width=32))


@st.composite
def spaces(draw: st.DrawFn) -> Spaces:
    """Make bounds where the lower one is lower, with an offset or without."""
    low, offset = draw(floats32(draw(sizes))), draw(st.none() | floats32(draw(sizes)))
    return Spaces(
        obs_size=draw(st.integers(1, 2**21)) if offset is None else offset.size,
        action_low=low,
        action_high=np.abs(low) * np.float32(2) + np.float32(1),
        obs_offset=offset,
    )


finite = st.floats(allow_nan=False, allow_infinity=False)
metrics = build(EpisodeMetric, name=labels, value=finite)


@st.composite
def segments(draw: st.DrawFn) -> Any:
    """Make segments whose arrays agree."""
    t, d, a = draw(sizes), draw(sizes), draw(sizes)
    terminated, truncated = draw(st.sampled_from([(False, False), (True, False), (False, True)]))
    some = st.lists(metrics, max_size=3)
    return draw(
        build(
            Segment, actor=names, seq=counts, generation=counts, epoch=counts,
            weights_version=counts, env=counts,
            obs=floats32(t, d, most=2.0**33), suggestion=floats32(t, a, most=2.0**19),
            log_prob=floats32(t, most=2.0**19), reward=floats32(t, most=2.0**33),
            final_obs=floats32(d, most=2.0**33),
            terminated=st.just(terminated), truncated=st.just(truncated),
            episode_return=st.floats(-1e10, 1e10), episode_length=st.integers(t, 2**63 - 1),
            metrics=some.map(tuple), short=st.booleans(),
        )
    )  # fmt: skip


@st.composite
def samples(draw: st.DrawFn) -> ReplaySample:
    """Make samples whose columns agree, with some of them missing."""
    b, d, a = draw(sizes), draw(sizes), draw(sizes)
    shapes = {"obs": (b, d), "action": (b, a), "next_obs": (b, d), "discount": (b,), "weight": (b,)}
    columns: dict[str, Any] = {n: draw(st.none() | floats32(*s)) for n, s in shapes.items()}
    begin, end = sorted(draw(st.tuples(counts, counts)))
    rows = st.lists(st.integers(begin, max(begin, end - 1)), min_size=b, max_size=b)
    row, reward = tuple(draw(st.just([]) | rows) if begin < end else []), draw(floats32(b))
    return ReplaySample(begin=begin, end=end, reward=reward, row=row, **columns)


some_json = st.dictionaries(texts, texts | st.floats() | st.lists(integers, max_size=2), max_size=3)
positive_int32 = st.integers(1, 2**31 - 1)
environments = build(
    EnvConfig, env_id=texts.filter(bool), kwargs=some_json.map(json.dumps),
    wrappers=st.lists(texts, max_size=3).map(tuple), action_repeat=positive_int32,
    frame_stack=positive_int32, max_episode_steps=st.integers(0, 2**31 - 1),
    timeout_s=st.floats(0.0, exclude_min=True, allow_infinity=False),
    info_metrics=st.lists(labels, max_size=3).map(tuple),
)  # fmt: skip
asking = build(Hello, actor=names, num_envs=st.just(0), env_id=st.just(""), spaces=st.none(),
               slot=st.just(-1), next_seq=st.just(-1))  # fmt: skip
joining = build(Hello, actor=names, num_envs=st.integers(1, 4096), env_id=texts.filter(bool),
                spaces=spaces(), slot=st.integers(-1, 999_999),
                next_seq=st.integers(-1, 2**63 - 1))  # fmt: skip
notices = build(Notice, quota_steps=counts.filter(bool))
slots = st.integers(-1, 999_999)
seconds = st.floats(0, allow_infinity=False)
statuses = build(
    ActorStatus, actor=names, slot=slots, environment_s=seconds, selection_s=seconds,
    sending_s=seconds, waiting_s=seconds,
)  # fmt: skip
modes = st.sampled_from(MODES)
played = build(
    EvaluatedEpisode, mode=modes, episode_return=st.floats(-1e10, 1e10),
    length=st.integers(1, 2**63 - 1),
)  # fmt: skip
ANY_MESSAGE: dict[type, st.SearchStrategy[Message]] = {
    Hello: asking | joining,
    Welcome: build(
        Welcome, run=names, spaces=spaces(), env=st.none() | environments, slot=slots,
        num_envs=st.integers(1, 4096), window=st.integers(1, 1000),
        short_steps=counts,
    ),
    Refusal: build(Refusal, retry_s=st.floats(0, 1e6)),
    Segment: segments(),
    Ack: build(Ack, wait_s=st.floats(0, 1e6)),
    Notice: notices,
    Weights: build(Weights, notice=notices),
    RecoveryEvent: build(RecoveryEvent),
    ActorStatus: statuses,
    RunStatus: build(
        RunStatus, total_steps=counts.filter(bool),
        actors=st.lists(statuses, max_size=3).map(tuple),
    ),
    ReplayInfo: build(ReplayInfo, spaces=spaces(), begin=st.just(3), end=st.integers(3, 2**63 - 1)),
    ReplayRequest: build(
        ReplayRequest, batch_size=st.integers(1, 4096), seed=counts, n_step=st.integers(1, 64),
        gamma=st.floats(0.0, 1.0), beta=st.floats(0.0, 1.0),
        fields=st.lists(st.sampled_from(COLUMNS), min_size=1, unique=True).map(tuple),
    ),
    ReplaySample: samples(),
    EvaluationRequest: build(EvaluationRequest, evaluator=names),
    EvaluationTask: build(
        EvaluationTask, modes=st.lists(modes, min_size=1, unique=True).map(tuple),
        episodes=st.integers(1, 1000), seed=counts,
    ),
    EvaluationResult: build(
        EvaluationResult, evaluator=names,
        episodes=st.lists(played, min_size=1, max_size=3).map(tuple),
        metrics=st.lists(metrics, max_size=3).map(tuple),
    ),
}  # fmt: skip
anything = st.recursive(
    st.none() | st.booleans() | integers | st.floats() | texts | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_every_message_survives_the_round_trip(kind: type, data: st.DataObject) -> None:
    """Types, values, shapes and every bit of the arrays; also when other kinds are expected."""
    message = data.draw(ANY_MESSAGE[kind])
    assert plain(decode(encode(message), kind)) == plain(message)
    assert plain(decode(encode(message), *KINDS)) == plain(message)


@settings(deadline=None, max_examples=500)
@given(payload=st.binary(max_size=200))
def test_garbage_is_malformed_and_nothing_else(payload: bytes) -> None:
    """Whatever arrives, a receiver has one exception to handle."""
    refusal_of(payload)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_flipped_bytes_and_foreign_values_never_raise_anything_else(
    kind: type, data: st.DataObject
) -> None:
    """Damage may leave a message, but never another exception than MalformedMessageError."""
    payload = bytearray(EXAMPLES[kind][1])
    for place in data.draw(st.lists(st.integers(0, len(payload) - 1), max_size=3)):
        payload[place] = data.draw(st.integers(0, 255))
    field = data.draw(st.sampled_from(sorted(body_of(kind))))
    for damaged in (bytes(payload), altered(kind, **{field: data.draw(anything)})):
        try:
            decode(damaged, kind)
        except MalformedMessageError:
            refusal_of(damaged, kind)
