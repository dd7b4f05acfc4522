"""Drawing in proportion to priorities: a tree of sums, compiled (docs/adr/0005).

Sixteen children a node, which are one cache line. A node is always the sum of its children, added
up anew and in one order: rounding does not build up, and the same leaves make the same tree.
"""

import numba
import numpy as np

from a2s.learner.replay.ring import Floats, Rows
from a2s.protocol.fields import Array

_FAN_OUT = 16
# Unsigned: a signed index is compared with 0 before every use, for it may count from the end.
_UNSIGNED = np.uintp
_1, _2, _4, _8 = _UNSIGNED(1), _UNSIGNED(2), _UNSIGNED(4), _UNSIGNED(8)

# Compiled once and kept on the disk; no array is copied, and the interpreter is free meanwhile.
_compiled = numba.njit(cache=True, nogil=True)


class SumTree:
    """Non-negative leaves, ``[N]``, drawn with a chance in proportion to each.

    Nodes, ``leaves`` among them, are float32, which halves the memory that a draw touches; the
    remainder of a share on the way down is float64.
    """

    def __init__(self, leaves: Array) -> None:
        counts = [len(leaves)]
        while counts[-1] > _FAN_OUT:
            counts.append(-(-counts[-1] // _FAN_OUT))
        sizes = [-(-count // _FAN_OUT) * _FAN_OUT for count in counts]
        self._starts = np.cumsum([0, *sizes[:-1]])
        self._nodes = np.zeros(sum(sizes), np.float32)
        self._nodes[: len(leaves)] = leaves
        self.leaves = self._nodes[: len(leaves)]
        _add_up(self._nodes, self._starts, 0, len(leaves))

    def assign(self, leaf: Rows, value: Array) -> None:
        """Set leaves, ``[B]``; where one is named twice, the last value counts."""
        _assign(self._nodes, self._starts, leaf, value)

    def assign_range(self, begin: int, end: int, value: float) -> None:
        """Set the leaves from ``begin`` to below ``end``."""
        self._nodes[begin:end] = value
        _add_up(self._nodes, self._starts, begin, end)

    def draw(self, batch_size: int, rng: np.random.Generator) -> Rows:
        """Draw leaves, one from each of ``batch_size`` equal shares of the total.

        The total must be positive. The indices are int64 ``[B]``, never that of a leaf of 0.
        """
        found: Rows = _find(self._nodes, self._starts, rng.random(batch_size))
        return found


@_compiled  # type: ignore[untyped-decorator]
def _two(nodes: Array, first: int) -> np.float32:
    total: np.float32 = nodes[first] + nodes[first + _1]
    return total


@_compiled  # type: ignore[untyped-decorator]
def _four(nodes: Array, first: int) -> np.float32:
    total: np.float32 = _two(nodes, first) + _two(nodes, first + _2)
    return total


@_compiled  # type: ignore[untyped-decorator]
def _sum_of(nodes: Array, first: int) -> np.float32:
    """Add up the children of a node by halves, so that no sum waits for more than three others."""
    at = _UNSIGNED(first)
    lower: np.float32 = _four(nodes, at) + _four(nodes, at + _4)
    upper: np.float32 = _four(nodes, at + _8) + _four(nodes, at + _8 + _4)
    return lower + upper


@_compiled  # type: ignore[untyped-decorator]
def _assign(nodes: Array, starts: Rows, leaf: Rows, value: Array) -> None:
    """Set leaves, then their ancestors; of neighbours with one parent, it is made once."""
    for i in range(len(leaf)):
        nodes[leaf[i]] = value[i]
    size = 1
    for level in range(len(starts) - 1):
        size *= _FAN_OUT
        last = -1
        for i in range(len(leaf)):
            node = leaf[i] // size
            if node != last:
                nodes[starts[level + 1] + node] = _sum_of(nodes, starts[level] + node * _FAN_OUT)
            last = node


@_compiled  # type: ignore[untyped-decorator]
def _add_up(nodes: Array, starts: Rows, begin: int, end: int) -> None:
    """Make the nodes above the leaves from ``begin`` to below ``end`` anew."""
    for level in range(len(starts) - 1):
        begin //= _FAN_OUT
        end = (end + _FAN_OUT - 1) // _FAN_OUT
        for node in range(begin, end):
            nodes[starts[level + 1] + node] = _sum_of(nodes, starts[level] + node * _FAN_OUT)


@_compiled  # type: ignore[untyped-decorator]
def _walk(nodes: Array, starts: Rows, within: Floats) -> tuple[int, Rows, Floats]:
    """Find a node in each of B shares, ``within`` 0..1 of it, on a level of at most 16 B nodes.

    Shares ascend, so that one walk over the level finds all of them. Returns the level, the nodes
    ``[B]``, and the remainder of each share in its node ``[B]``.
    """
    total = 0.0
    for child in range(starts[-1], len(nodes)):
        total += nodes[child]
    level, end = len(starts) - 1, len(nodes)
    while level > 0 and starts[level] - starts[level - 1] <= _FAN_OUT * len(within):
        end, level = starts[level], level - 1
    while nodes[end - 1] == 0.0:
        end -= 1
    found, rest = np.empty(len(within), np.int64), np.empty(len(within), np.float64)
    node, passed = starts[level], 0.0
    for i in range(len(within)):
        wanted = (i + within[i]) * (total / len(within))
        while node < end - 1 and wanted - passed >= nodes[node]:
            passed += nodes[node]
            node += 1
        found[i], rest[i] = node - starts[level], wanted - passed
    return level, found, rest


@_compiled  # type: ignore[untyped-decorator]
def _find(nodes: Array, starts: Rows, within: Floats) -> Rows:
    """Find a leaf in each of B equal shares of the total, ``within`` 0..1 of it; never one of 0.

    From where the walk ends all go down level by level, so that the memory of many is waited for at
    once. In a node the children are halved four times, without a branch that a processor would have
    to guess: the upper half is taken if the remainder reaches beyond the lower, and the upper half
    is not empty.
    """
    walked: int
    found: Rows
    walked, found, rest = _walk(nodes, starts, within)
    for level in range(walked - 1, -1, -1):
        for i in range(len(within)):
            first, left = _UNSIGNED(starts[level] + found[i] * _FAN_OUT), rest[i]
            at = first
            a, b = _four(nodes, at), _four(nodes, at + _4)
            c, d = _four(nodes, at + _8), _four(nodes, at + _8 + _4)
            upper = (left >= a + b) & (c + d > 0.0)
            left -= a + b if upper else 0.0
            at += _8 if upper else _UNSIGNED(0)
            lower, higher = c if upper else a, d if upper else b
            upper = (left >= lower) & (higher > 0.0)
            left -= lower if upper else 0.0
            at += _4 if upper else _UNSIGNED(0)
            lower = _two(nodes, at)
            upper = (left >= lower) & (_two(nodes, at + _2) > 0.0)
            left -= lower if upper else 0.0
            at += _2 if upper else _UNSIGNED(0)
            lower = np.float64(nodes[at])
            upper = (left >= lower) & (nodes[at + _1] > 0.0)
            left -= lower if upper else 0.0
            at += _1 if upper else _UNSIGNED(0)
            found[i], rest[i] = found[i] * _FAN_OUT + np.int64(at - first), left
    return found
