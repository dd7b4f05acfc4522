"""Whether a graph is one that a learner writes: looked at before ONNX Runtime sees it.

Of the ONNX format (onnx.proto) this reads no more than that needs; an actor has no onnx package.
"""

import math
from collections.abc import Collection, Iterator
from functools import lru_cache

from a2s.protocol.errors import MalformedMessageError

# What a2s.learner.export writes; none of these holds a graph of its own.
OPERATORS = frozenset({
    "Add", "ArgMax", "Clip", "Concat", "Div", "Erf", "Exp", "GatherElements", "GatherND",
    "Gemm", "Identity", "LayerNormalization", "MatMul", "Max", "Mean", "Min", "Mul",
    "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceSum", "ReduceSumSquare", "Relu", "Sigmoid",
    "Sign", "Softmax", "Softplus", "Split", "Squeeze", "Sub", "Tanh", "Unsqueeze",
})  # fmt: skip
MAX_NODES = 4096
# Numbers of the fields that may occur, and of those that are read.
_MODEL, _GRAPH_FIELD = {1, 2, 3, 4, 5, 6, 7, 8, 14}, 7  # all but functions and training
_GRAPH, _NODE_FIELD, _INITIALIZER, _INPUT = {1, 2, 5, 10, 11, 12, 13}, 1, 5, 11
_NODE, _READS, _WRITES, _KIND, _ATTRIBUTE, _DOMAIN = {1, 2, 3, 4, 5, 6, 7}, 1, 2, 4, 5, 7
_PLAIN_ATTRIBUTE = {1, 2, 3, 4, 7, 8, 9, 13, 20}  # numbers and texts: neither graph nor tensor
_TENSOR, _DIMS, _TYPE, _NAME, _RAW = {1, 2, 8, 9, 12}, 1, 2, 8, 9  # nothing outside this file
_INPUT_NAME = 1
_BYTES_OF = {1: 4, 7: 8}  # float32, int64
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10

Field = tuple[int, int | bytes]


def check_graph(graph: bytes) -> None:
    """Look at a graph, which may be anything.

    Raises:
        MalformedMessageError: It has an operator, or a part, that no learner writes.
    """
    try:
        parts = [b for n, b in _fields(graph, _MODEL, "the model") if n == _GRAPH_FIELD]
        nodes, inputs = [], []
        for number, part in (
            field for each in parts for field in _fields(_bytes(each), _GRAPH, "")
        ):
            if number == _NODE_FIELD:
                nodes.append(_bytes(part))
            elif number == _INITIALIZER:
                _check_numbers(_bytes(part))
            elif number == _INPUT:
                inputs += [n for at, n in _fields(_bytes(part)) if at == _INPUT_NAME]
        _check_nodes(tuple(nodes), tuple(map(_bytes, inputs)))
    except (IndexError, ValueError) as error:
        raise _refused("something that is not ONNX", "a graph") from error


@lru_cache(maxsize=8)
def _check_nodes(nodes: tuple[bytes, ...], inputs: tuple[bytes, ...]) -> None:
    """Every version of the weights has the same nodes."""
    if len(nodes) > MAX_NODES:
        raise _refused(f"{len(nodes)} nodes", f"at most {MAX_NODES}")
    moving = set(inputs)
    for node in nodes:
        kind, reads, writes = _read_node(node)
        if kind not in OPERATORS:
            raise _refused(f"the operator {_brief(kind)}", "one that a learner writes")
        if not moving.intersection(reads):  # it would be computed when the graph is loaded
            raise _refused(f"a {kind} of constants", "no such node")
        moving.update(writes)


def _read_node(node: bytes) -> tuple[str, list[bytes], list[bytes]]:
    """Its operator, and the names of what it reads and writes."""
    found: dict[int, list[bytes]] = {number: [] for number in _NODE}
    for number, value in _fields(node, _NODE, "a node"):
        found[number].append(_bytes(value))
    for attribute in found[_ATTRIBUTE]:
        list(_fields(attribute, _PLAIN_ATTRIBUTE, "an attribute"))
    if any(found[_DOMAIN]):
        raise _refused(f"operators of {_brief(found[_DOMAIN])}", "those of ONNX itself")
    return b"".join(found[_KIND]).decode(), found[_READS], found[_WRITES]


def _check_numbers(tensor: bytes) -> None:
    """All numbers of a tensor are in the graph, as many as it says."""
    dims, kind, size = list[int](), 0, 0
    for number, value in _fields(tensor, _TENSOR, "a tensor"):
        if number == _DIMS:
            dims += [value] if isinstance(value, int) else _varints(value)
        elif number == _TYPE:
            kind = value if isinstance(value, int) else 0
        elif number == _RAW:
            size = len(_bytes(value))
    if kind not in _BYTES_OF or size != _BYTES_OF[kind] * math.prod(dims):
        raise _refused(
            f"a tensor of type {kind} and shape {dims[:4]} in {size} bytes", "its numbers"
        )


def _fields(data: bytes, allowed: Collection[int] = (), where: str = "") -> Iterator[Field]:
    """Read the fields of a protobuf message; without ``allowed`` any.

    Raises:
        IndexError, ValueError: It is none.
    """
    position, end = 0, len(data)
    while position < end:
        tag, position = _varint(data, position)
        number, form = tag >> 3, tag & 7
        if allowed and number not in allowed:
            raise _refused(f"field {number} of {where or 'the graph'}", "what a learner writes")
        if form == _VARINT:
            value, position = _varint(data, position)
            yield number, value
            continue
        size = {_FIXED64: 8, _FIXED32: 4}.get(form)
        if form == _LENGTH:
            size, position = _varint(data, position)
        if size is None or position + size > end:
            raise ValueError
        yield number, data[position : position + size]
        position += size


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = 0
    for index in range(_MAX_VARINT_BYTES):
        byte = data[position + index]
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, position + index + 1
    raise ValueError


def _varints(data: bytes) -> list[int]:
    values, position = [], 0
    while position < len(data):
        value, position = _varint(data, position)
        values.append(value)
    return values


def _bytes(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise ValueError  # noqa: TRY004  # it is what is read that is wrong
    return value


def _brief(value: object) -> str:
    return f"{value!r:.40}"


def _refused(found: str, expected: str) -> MalformedMessageError:
    return MalformedMessageError(f"policy graph: found {found}, expected {expected}")
