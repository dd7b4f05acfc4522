"""Messages to bytes and back: msgpack maps with a schema version; see ``docs/protocol.md``.

Bytes and values are counted before anything is decoded, names and types checked before anything is
built.
Fields may be added at any time: an unknown one is ignored, a missing one has its default.
"""

import operator
import reprlib
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

import msgpack
import numpy as np

from a2s.protocol import evaluation_messages, messages, replay_messages
from a2s.protocol.counting import has_too_many_values
from a2s.protocol.errors import MalformedMessageError, OversizeMessageError, SchemaMismatchError
from a2s.protocol.keys import MAJOR

MIB = 1 << 20
_DTYPE = np.dtype("<f4")
_ARRAY, _SIZES = {"dtype", "shape", "data"}, "at most two sizes that fit data"

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
        f"this actor speaks protocol 1, the learner protocol {MAJOR}: it lacks how the "
        "environment is made, and the keys that begin with a2s/2/; install the learner's a2s there"
    )
    return bytes(msgpack.packb({"a2s": 1, "kind": "Refusal", "reason": reason}))


def encode(message: Message) -> bytes:
    """Turn a message into bytes.

    Raises:
        OversizeMessageError: A receiver would refuse it.
    """
    kind = type(message)
    payload: bytes = msgpack.packb({"a2s": MAJOR, "kind": kind.__name__, **_to_map(message)})
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
    if type(version) is not int or version != MAJOR:
        spoken = _brief(version)
        raise SchemaMismatchError(f"peer speaks protocol {spoken}, this is {MAJOR}")
    name = body.pop("kind", None)
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind not in kinds:
        raise MalformedMessageError(f"kind: found {_brief(name)}, expected {expected}")
    return typing.cast("M", _from_map(body, _plan(typing.cast("type", kind))))


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


Read = Callable[[Any], Any]
Write = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class _Plan:
    """How messages of a kind are read and written; made once, because all of it is needed often."""

    kind: type
    names: tuple[str, ...]
    values: Callable[[Any], tuple[Any, ...]]  # of a message's fields
    read: tuple[tuple[str, Read], ...]
    write: tuple[tuple[str, Write], ...]  # those that are not written as they are
    required: frozenset[str]


@cache
def _plan(kind: type) -> _Plan:
    hints, names = typing.get_type_hints(kind), tuple(f.name for f in fields(kind))
    values = operator.attrgetter(*names) if len(names) > 1 else lambda m: (getattr(m, names[0]),)
    written = ((name, _writer(hints[name])) for name in names)
    return _Plan(
        kind=kind,
        names=names,
        values=values,
        read=tuple((name, _reader(hints[name], f"{kind.__name__}.{name}")) for name in names),
        write=tuple((name, write) for name, write in written if write is not None),
        required=frozenset(f.name for f in fields(kind) if f.default is MISSING),
    )


def _to_map(message: Any) -> dict[str, Any]:
    kind: type = type(message)
    plan = _plan(kind)
    body = dict(zip(plan.names, plan.values(message), strict=True))
    for name, write in plan.write:
        body[name] = write(body[name])
    return body


def _writer(hint: Any) -> Write | None:
    """Make the function that turns a field's value into what msgpack knows; ``None``: it does."""
    origin = typing.get_origin(hint)
    if origin is np.ndarray:
        return _write_array
    if origin is types.UnionType:
        inner = _writer(_of_optional(hint))
        return inner and (lambda value: None if value is None else inner(value))
    if origin is tuple:
        item = _writer(typing.get_args(hint)[0])
        return (lambda value: [item(each) for each in value]) if item else list
    return _to_map if is_dataclass(hint) else None


def _write_array(value: np.ndarray) -> dict[str, Any]:
    data = np.ascontiguousarray(value, dtype=_DTYPE)
    return {"dtype": _DTYPE.str, "shape": list(data.shape), "data": data.tobytes()}


def _from_map(body: Any, plan: _Plan) -> Any:
    if not isinstance(body, dict):
        raise _unexpected(body, plan.kind.__name__, "a map of its fields")
    if not plan.required <= body.keys():
        missing = [name for name in plan.names if name in plan.required and name not in body]
        raise MalformedMessageError(f"{plan.kind.__name__}: missing fields {missing}")
    return plan.kind(**{name: read(body[name]) for name, read in plan.read if name in body})


def _reader(hint: Any, where: str) -> Read:
    """Make the function that checks a decoded value against a field's type."""
    origin = typing.get_origin(hint)
    if origin is np.ndarray:
        return lambda value: _read_array(value, where)
    if origin is typing.Literal:
        choices = typing.get_args(hint)
        return _checked(lambda value: value in choices, where, f"one of {choices}")
    if origin is types.UnionType:
        inner = _reader(_of_optional(hint), where)
        return lambda value: None if value is None else inner(value)
    if origin is tuple:
        item = _reader(typing.get_args(hint)[0], where)
        items = _checked(lambda value: isinstance(value, list), where, "an array")
        return lambda value: tuple(item(each) for each in items(value))
    if is_dataclass(hint):
        return lambda value: _from_map(value, _plan(typing.cast("type", hint)))
    if hint is float:
        number = _checked(lambda value: type(value) in (float, int), where, "a number")
        return lambda value: value if type(value) is float else float(number(value))
    if hint is int:
        return _checked(
            lambda value: type(value) is int and value < 1 << 63, where, "an integer below 2^63"
        )
    return _checked(lambda value: type(value) is hint, where, hint.__name__)


def _checked(is_right: Callable[[Any], bool], where: str, expected: str) -> Read:
    def read(value: Any) -> Any:
        if is_right(value):
            return value
        raise _unexpected(value, where, expected)

    return read


def _of_optional(hint: Any) -> Any:
    return next(each for each in typing.get_args(hint) if each is not type(None))


def _unexpected(value: Any, where: str, expected: str) -> MalformedMessageError:
    return MalformedMessageError(f"{where}: found {_brief(value)}, expected {expected}")


def _brief(value: Any) -> str:
    """Show a value of any size and depth in at most 80 characters."""
    return f"{reprlib.repr(value):.80}"


def _read_array(value: Any, where: str) -> np.ndarray:
    if not (isinstance(value, dict) and value.keys() == _ARRAY):
        raise _unexpected(value, where, "an array map of dtype, shape and data")
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    if dtype != _DTYPE.str:
        raise _unexpected(dtype, f"{where}: dtype", repr(_DTYPE.str))
    if not isinstance(data, bytes):
        raise _unexpected(data, f"{where}: data", "bytes")
    most = len(data)
    num_bytes = _DTYPE.itemsize
    if not (isinstance(shape, list) and len(shape) <= 2):
        raise _unexpected(shape, f"{where}: shape", _SIZES)
    for size in shape:
        if type(size) is not int or not 0 <= size <= most:
            raise _unexpected(shape, f"{where}: shape", _SIZES)
        num_bytes *= size
    if most != num_bytes:
        raise _unexpected(most, f"{where}: data", f"{num_bytes} bytes")
    return np.frombuffer(data, dtype=_DTYPE).reshape(shape)
