"""An example of every message, its bytes, and what can be changed about them."""

from dataclasses import fields, is_dataclass
from typing import Any, get_args

import msgpack
import numpy as np
import pytest

from a2s.protocol.codec import Message, decode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import (
    EvaluatedEpisode,
    EvaluationRequest,
    EvaluationResult,
    EvaluationTask,
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
from a2s.protocol.replay_messages import ReplayInfo, ReplayRequest, ReplaySample

KINDS = get_args(Message)


def f32(values: object) -> Array:
    """Make a float32 array."""
    return np.array(values, np.float32)


# Every byte is written by hand, field by field: a fix* header carries its own size
# (\x8N map, \x9N array, \xaN str), \xcb is a float64, \xc4 a bin of up to 255 bytes.
F4_1 = b"\x83\xa5dtype\xa3<f4\xa5shape\x91\x01\xa4data\xc4\x04"  # a float32 [1] follows
F4_1_1 = b"\x83\xa5dtype\xa3<f4\xa5shape\x92\x01\x01\xa4data\xc4\x04"  # a float32 [1, 1] follows
ONE, MINUS_ONE, HALF = b"\x00\x00\x80\x3f", b"\x00\x00\x80\xbf", b"\x00\x00\x00\x3f"
FLOAT64_HALF = b"\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00"
SPACES = Spaces(obs_size=1, action_low=f32([-1]), action_high=f32([1]), obs_offset=f32([0.5]))
SPACES_BYTES = (
    b"\x84\xa8obs_size\x01\xaaaction_low" + F4_1 + MINUS_ONE + b"\xabaction_high" + F4_1 + ONE +
    b"\xaaobs_offset" + F4_1 + HALF
)  # fmt: skip
ENV = EnvConfig(
    env_id="E", kwargs='{"n":1}', wrappers=("m:C",), action_repeat=2, frame_stack=3,
    max_episode_steps=1000, timeout_s=0.5, info_metrics=("x",),
)  # fmt: skip
ENV_BYTES = (
    b'\x88\xa6env_id\xa1E\xa6kwargs\xa7{"n":1}\xa8wrappers\x91\xa3m:C\xadaction_repeat\x02'
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
STATUS = ActorStatus(
    actor="h-1", slot=0, weights_version=2, epoch=0, env_steps=128, episodes=1, segments_sent=3,
    segments_answered=2, spooled_steps=5, leaving=True, doing="d", dropped_steps=4, trouble="t",
    environment_s=0.5, selection_s=0.5, sending_s=0.5, waiting_s=0.5,
)  # fmt: skip
STATUS_FIELDS = (
    b"\xa5actor\xa3h-1\xa4slot\x00\xafweights_version\x02\xa5epoch\x00\xa9env_steps\xcc\x80"
    b"\xa8episodes\x01\xadsegments_sent\x03\xb1segments_answered\x02\xadspooled_steps\x05"
    b"\xa7leaving\xc3\xa5doing\xa1d\xaddropped_steps\x04\xa7trouble\xa1t"
    b"\xadenvironment_s"
    + FLOAT64_HALF
    + b"\xabselection_s"
    + FLOAT64_HALF
    + b"\xa9sending_s"
    + FLOAT64_HALF
    + b"\xa9waiting_s"
    + FLOAT64_HALF
)
GOLDEN: list[tuple[Message, bytes]] = [
    (
        Hello(actor="h-1", num_envs=2, env_id="E", spaces=SPACES, cause="c", slot=1, next_seq=7),
        b"\x89\xa3a2s\x02\xa4kind\xa5Hello\xa5actor\xa3h-1\xa8num_envs\x02\xa6env_id\xa1E"
        b"\xa6spaces" + SPACES_BYTES + b"\xa5cause\xa1c\xa4slot\x01\xa8next_seq\x07",
    ),
    (
        Hello(actor="h-1", num_envs=0, env_id="", spaces=None),
        b"\x89\xa3a2s\x02\xa4kind\xa5Hello"
        b"\xa5actor\xa3h-1\xa8num_envs\x00\xa6env_id\xa0\xa6spaces\xc0\xa5cause\xa0\xa4slot\xff"
        b"\xa8next_seq\xff",
    ),
    (
        Welcome(
            run="r", generation=1, env_id="E", spaces=SPACES, num_envs=8, clock="lockstep",
            slot=-1, seed=65536, env=ENV, window=16, short_steps=3,
        ),
        b"\x8d\xa3a2s\x02\xa4kind\xa7Welcome\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E"
        b"\xa6spaces" + SPACES_BYTES + b"\xa8num_envs\x08\xa5clock\xa8lockstep\xa4slot\xff"
        b"\xa4seed\xce\x00\x01\x00\x00\xa3env" + ENV_BYTES + b"\xa6window\x10"
        b"\xabshort_steps\x03",
    ),
    (
        Refusal(reason="no", retry_s=0.5),
        b"\x84\xa3a2s\x02\xa4kind\xa7Refusal\xa6reason\xa2no\xa7retry_s" + FLOAT64_HALF,
    ),
    (
        Segment(
            actor="h-1", seq=7, generation=1, epoch=0, weights_version=2, env=0, obs=f32([[1]]),
            suggestion=f32([[0.5]]), log_prob=f32([-1]), reward=f32([1]), final_obs=f32([0.5]),
            terminated=True, truncated=False, episode_return=0.5, episode_length=1,
            metrics=(EpisodeMetric(name="is_success", value=0.5),), short=True,
        ),
        b"\xde\x00\x13\xa3a2s\x02\xa4kind\xa7Segment"  # 19 entries: a map 16
        b"\xa5actor\xa3h-1\xa3seq\x07\xaageneration\x01\xa5epoch\x00\xafweights_version\x02"
        b"\xa3env\x00\xa3obs" + F4_1_1 + ONE + b"\xaasuggestion" + F4_1_1 + HALF +
        b"\xa8log_prob" + F4_1 + MINUS_ONE + b"\xa6reward" + F4_1 + ONE +
        b"\xa9final_obs" + F4_1 + HALF + b"\xaaterminated\xc3\xa9truncated\xc2"
        b"\xaeepisode_return" + FLOAT64_HALF + b"\xaeepisode_length\x01"
        b"\xa7metrics\x91\x82\xa4name\xaais_success\xa5value" + FLOAT64_HALF + b"\xa5short\xc3",
    ),
    (
        Ack(verdict="accepted", reason="", generation=1, epoch=0, weights_version=2, wait_s=0.5),
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
            id=1, generation=1, epoch=2, draw=0.5, probability=0.5, r=0.5, r_best=0.5,
            restored_version=3, weights_version=4,
        ),
        b"\x8b\xa3a2s\x02\xa4kind\xadRecoveryEvent\xa2id\x01\xaageneration\x01\xa5epoch\x02"
        b"\xa4draw" + FLOAT64_HALF + b"\xabprobability" + FLOAT64_HALF +
        b"\xa1r" + FLOAT64_HALF + b"\xa6r_best" + FLOAT64_HALF +
        b"\xb0restored_version\x03\xafweights_version\x04",
    ),
    (STATUS, b"\xde\x00\x13\xa3a2s\x02\xa4kind\xabActorStatus" + STATUS_FIELDS),
    (
        RunStatus(
            run="r", generation=1, env_id="E", env_steps=2, total_steps=3, episodes=4, updates=5,
            weights_version=6, epoch=7, return_mean=0.5, env_steps_per_s=0.5, waiting_for="",
            actors=(STATUS,), learning_s=0.5, limited_by="network", unix_s=0.5,
            evaluation_return=0.5, evaluation_steps=8, variant="v", ended="e",
        ),
        b"\xde\x00\x16\xa3a2s\x02\xa4kind\xa9RunStatus\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E"
        b"\xa9env_steps\x02\xabtotal_steps\x03\xa8episodes\x04\xa7updates\x05"
        b"\xafweights_version\x06\xa5epoch\x07\xabreturn_mean" + FLOAT64_HALF +
        b"\xafenv_steps_per_s" + FLOAT64_HALF + b"\xabwaiting_for\xa0"
        b"\xa6actors\x91\xde\x00\x11" + STATUS_FIELDS +
        b"\xaalearning_s" + FLOAT64_HALF + b"\xaalimited_by\xa7network\xa6unix_s" + FLOAT64_HALF +
        b"\xb1evaluation_return" + FLOAT64_HALF + b"\xb0evaluation_steps\x08"
        b"\xa7variant\xa1v\xa5ended\xa1e",
    ),
    (
        ReplayInfo(run="r", generation=1, env_id="E", spaces=SPACES, capacity=9, begin=2, end=3),
        b"\x89\xa3a2s\x02\xa4kind\xaaReplayInfo\xa3run\xa1r\xaageneration\x01\xa6env_id\xa1E"
        b"\xa6spaces" + SPACES_BYTES + b"\xa8capacity\x09\xa5begin\x02\xa3end\x03",
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
    (
        EvaluationRequest(evaluator="e-1"),
        b"\x83\xa3a2s\x02\xa4kind\xb1EvaluationRequest\xa9evaluator\xa3e-1",
    ),
    (
        EvaluationTask(
            generation=1, number=2, env_steps=3, weights_version=4, modes=("mean",), episodes=5,
            seed=6, graph=b"\x00",
        ),
        b"\x8a\xa3a2s\x02\xa4kind\xaeEvaluationTask\xaageneration\x01\xa6number\x02"
        b"\xa9env_steps\x03\xafweights_version\x04\xa5modes\x91\xa4mean\xa8episodes\x05"
        b"\xa4seed\x06\xa5graph\xc4\x01\x00",
    ),
    (
        EvaluationResult(
            evaluator="e-1", generation=1, number=2,
            episodes=(EvaluatedEpisode(mode="best-of-k", episode_return=0.5, length=3),),
            metrics=(EpisodeMetric(name="x", value=0.5),),
        ),
        b"\x87\xa3a2s\x02\xa4kind\xb0EvaluationResult\xa9evaluator\xa3e-1"
        b"\xaageneration\x01\xa6number\x02"
        b"\xa8episodes\x91\x83\xa4mode\xa9best-of-k\xaeepisode_return" + FLOAT64_HALF +
        b"\xa6length\x03\xa7metrics\x91\x82\xa4name\xa1x\xa5value" + FLOAT64_HALF,
    ),
]  # fmt: skip
EXAMPLES: dict[type, tuple[Any, bytes]] = {
    type(message): (message, payload) for message, payload in reversed(GOLDEN)
}
# What who leaves a field out means by it; it never changes.
DEFAULTS: dict[type, dict[str, object]] = {
    Spaces: {"obs_offset": None},
    EnvConfig: {
        "kwargs": "{}", "wrappers": (), "action_repeat": 1, "frame_stack": 1,
        "max_episode_steps": 0, "timeout_s": 120.0, "info_metrics": (),
    },
    Hello: {"cause": "", "slot": -1, "next_seq": -1},
    Welcome: {"env": None, "window": 1, "short_steps": 0},
    Refusal: {"retry_s": 0.0},
    Segment: {"metrics": (), "short": False},
    ActorStatus: {
        "doing": "", "dropped_steps": 0, "trouble": "",
        "environment_s": 0.0, "selection_s": 0.0, "sending_s": 0.0, "waiting_s": 0.0,
    },
    RunStatus: {
        "learning_s": 0.0, "limited_by": "", "unix_s": 0.0,
        "evaluation_return": 0.0, "evaluation_steps": 0, "variant": "", "ended": "",
    },
    EvaluationResult: {"metrics": ()},
}  # fmt: skip


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
    """Return the map that the example of a kind is on the wire."""
    body: dict[str, Any] = msgpack.unpackb(EXAMPLES[kind][1])
    return body


def altered(kind: type, /, **changes: Any) -> bytes:
    """Pack the example of a kind with some entries changed."""
    payload: bytes = msgpack.packb(body_of(kind) | changes)
    return payload
