"""Messages to bytes and back: msgpack maps with a schema version; see ``docs/protocol.md``.

Bytes and values are counted before anything is decoded, names and types checked before anything is
built.
Fields may be added at any time: an unknown one is ignored, a missing one has its default.
"""

import math
import reprlib
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

import msgpack
import numpy as np

from a2s.protocol import evaluation_messages, keys, messages, replay_messages
from a2s.protocol.counting import has_too_many_values
from a2s.protocol.errors import MalformedMessageError, OversizeMessageError, SchemaMismatchError

SCHEMA_VERSION = keys.MAJOR
MIB = 1 << 20
_DTYPE = np.dtype("<f4")

Message = (
    messages.Hello
    | messages.Welcome
    | messages.Refusal
    | messages.Segment
    | messages.Ack
    | messages.Notice
    | messages.Weights
    | messages.RecoveryEvent
    | messages.ActorStatus
    | messages.RunStatus
    | replay_messages.ReplayInfo
    | replay_messages.ReplayRequest
    | replay_messages.ReplaySample
    | evaluation_messages.EvaluationRequest
    | evaluation_messages.EvaluationTask
    | evaluation_messages.EvaluationResult
)
M = TypeVar("M", bound=Message)

MAX_BYTES: dict[type, int] = dict.fromkeys(typing.get_args(Message), MIB) | {
    messages.Welcome: 16 * MIB,  # an offset of a million observations is 4 MB
    messages.Segment: 16 * MIB,
    messages.Weights: 256 * MIB,
    messages.RunStatus: 16 * MIB,
    replay_messages.ReplayInfo: 16 * MIB,
    replay_messages.ReplaySample: 16 * MIB,
    evaluation_messages.EvaluationTask: 256 * MIB,
}
_MAX_VALUES = dict.fromkeys(MAX_BYTES, 1 << 14) | {messages.RunStatus: 1 << 18}
_MAX_ENTRIES = 1 << 13  # of an array or a map: they get their memory when they are announced
_KINDS = {kind.__name__: kind for kind in MAX_BYTES}


def refuse_major_1() -> bytes:
    """Make a refusal that an actor of protocol 1 can read."""
    reason = (
        f"this actor speaks protocol 1, the learner protocol {SCHEMA_VERSION}: it lacks how the "
        "environment is made, and the keys that begin with a2s/2/; install the learner's a2s there"
    )
    return bytes(msgpack.packb({"a2s": 1, "kind": "Refusal", "reason": reason}))


def encode(message: Message) -> bytes:
    """Turn a message into bytes.

    Raises:
        OversizeMessageError: A receiver would refuse it.
    """
    kind = type(message)
    payload: bytes = msgpack.packb(
        {"a2s": SCHEMA_VERSION, "kind": kind.__name__, **_to_map(message)}
    )
    _check_size(len(payload), kind)
    return payload


def decode(payload: bytes, *kinds: type[M]) -> M:
    """Turn bytes into a message of one of the expected kinds.

    Raises:
        MalformedMessageError: Oversize, not msgpack, another major version or kind, missing
            fields, wrong types, or values that the message itself refuses.
    """
    _check_size(len(payload), *kinds)
    expected = " or ".join(kind.__name__ for kind in kinds)
    try:
        body = _unpack(payload, max(_MAX_VALUES[kind] for kind in kinds))
    except (ValueError, RecursionError) as error:
        is_deep = not isinstance(error, msgpack.FormatError)
        reason = str(error) or ("nested too deeply" if is_deep else "a byte that begins no value")
        raise MalformedMessageError(f"{expected}: not msgpack ({reason})") from error
    if not isinstance(body, dict):
        raise MalformedMessageError(f"{expected}: found {type(body).__name__}, expected a map")
    version = body.pop("a2s", None)
    if type(version) is not int or version != SCHEMA_VERSION:
        spoken = _brief(version)
        raise SchemaMismatchError(f"peer speaks protocol {spoken}, this is {SCHEMA_VERSION}")
    name = body.pop("kind", None)
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind not in kinds:
        raise MalformedMessageError(f"kind: found {_brief(name)}, expected {expected}")
    return typing.cast("M", _from_map(body, kind))


def _unpack(payload: bytes, most: int) -> Any:
    if has_too_many_values(payload, most):
        raise ValueError(f"more than {most} values")
    return msgpack.unpackb(
        payload, strict_map_key=True, max_array_len=_MAX_ENTRIES, max_map_len=_MAX_ENTRIES
    )


def _check_size(num_bytes: int, *kinds: type) -> None:
    limit = max(MAX_BYTES[kind] for kind in kinds)
    if num_bytes > limit:
        name = " or ".join(kind.__name__ for kind in kinds)
        raise OversizeMessageError(f"{name}: found {num_bytes} bytes, expected at most {limit}")


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    read: Callable[[Any, str], Any]
    required: bool


@cache
def _plan(kind: type) -> tuple[_Field, ...]:
    hints = typing.get_type_hints(kind)
    return tuple(_Field(f.name, _reader(hints[f.name]), f.default is MISSING) for f in fields(kind))


def _to_map(message: Any) -> dict[str, Any]:
    kind: type = type(message)
    return {f.name: _to_wire(getattr(message, f.name)) for f in _plan(kind)}


def _to_wire(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, dtype=_DTYPE)
        return {"dtype": _DTYPE.str, "shape": list(data.shape), "data": data.tobytes()}
    if isinstance(value, tuple):
        return [_to_wire(item) for item in value]
    return _to_map(value) if is_dataclass(value) else value


def _from_map(body: Any, kind: type) -> Any:
    plan = _plan(kind)
    _expect(isinstance(body, dict), body, kind.__name__, "a map of its fields")
    missing = [f.name for f in plan if f.required and f.name not in body]
    if missing:
        raise MalformedMessageError(f"{kind.__name__}: missing fields {missing}")
    present = (f for f in plan if f.name in body)
    return kind(**{f.name: f.read(body[f.name], f"{kind.__name__}.{f.name}") for f in present})


def _reader(hint: Any) -> Callable[[Any, str], Any]:
    """Make the function that checks a decoded value against a field's type."""
    origin = typing.get_origin(hint)
    if origin is np.ndarray:
        return _read_array
    if origin is typing.Literal:
        choices = typing.get_args(hint)
        return lambda value, where: _expect(value in choices, value, where, f"one of {choices}")
    if origin is types.UnionType:
        inner = _reader(next(a for a in typing.get_args(hint) if a is not type(None)))
        return lambda value, where: None if value is None else inner(value, where)
    if origin is tuple:
        item = _reader(typing.get_args(hint)[0])
        return lambda value, where: tuple(
            item(v, where) for v in _expect(isinstance(value, list), value, where, "an array")
        )
    if is_dataclass(hint):
        return lambda value, _where: _from_map(value, typing.cast("type", hint))
    if hint is float:
        return lambda value, where: float(
            _expect(type(value) in (float, int), value, where, "a number")
        )
    if hint is int:
        return lambda value, where: _expect(
            type(value) is int and value < 1 << 63, value, where, "an integer below 2^63"
        )
    return lambda value, where: _expect(type(value) is hint, value, where, hint.__name__)


def _expect(condition: bool, value: Any, where: str, expected: str) -> Any:
    if not condition:
        raise MalformedMessageError(f"{where}: found {_brief(value)}, expected {expected}")
    return value


def _brief(value: Any) -> str:
    """Show a value of any size and depth in at most 80 characters."""
    return f"{reprlib.repr(value):.80}"


def _read_array(value: Any, where: str) -> np.ndarray:
    is_map = isinstance(value, dict) and value.keys() == {"dtype", "shape", "data"}
    _expect(is_map, value, where, "an array map of dtype, shape and data")
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    _expect(dtype == _DTYPE.str, dtype, f"{where}: dtype", repr(_DTYPE.str))
    _expect(isinstance(data, bytes), data, f"{where}: data", "bytes")
    sizes = isinstance(shape, list) and all(type(n) is int and 0 <= n <= len(data) for n in shape)
    _expect(sizes and len(shape) <= 2, shape, f"{where}: shape", "at most two sizes that fit data")
    num_bytes = _DTYPE.itemsize * math.prod(shape)
    _expect(len(data) == num_bytes, len(data), f"{where}: data", f"{num_bytes} bytes")
    return np.frombuffer(data, dtype=_DTYPE).reshape(shape)
