"""Drawing in proportion to priorities: a tree of sums, every level handled for a whole batch.

Sixteen children a node: with numpy the price is per level, and a level of sixteen costs hardly
more than one of two (docs/adr/0005). A node is always the sum of its children, computed anew, so
rounding does not build up.
"""

import numpy as np
import numpy.typing as npt

from a2s.learner.replay.transitions import Rows
from a2s.protocol.messages import Array

Floats = npt.NDArray[np.float64]

_FAN_OUT = 16
_MOST_ROOTS = 8192
_ONES = np.ones(_FAN_OUT, np.float32)
_PREFIX = np.triu(np.ones((_FAN_OUT, _FAN_OUT), np.float32))


class SumTree:
    """Non-negative leaves, drawn with a chance in proportion to each.

    Nodes are float32, which halves the memory that a draw touches; the top level is added up in
    float64.

    Args:
        leaves: Their values, ``[N]``.
    """

    def __init__(self, leaves: Array) -> None:
        self._levels = [_padded(leaves)]
        while len(self._levels[-1]) > _MOST_ROOTS:
            self._levels.append(_padded(self._levels[-1].reshape(-1, _FAN_OUT) @ _ONES))

    @property
    def leaves(self) -> Array:
        """The values, float32 ``[N]`` and some zeros behind them; not to be written to."""
        return self._levels[0]

    @property
    def total(self) -> float:
        """Sum of all leaves."""
        return float(self._levels[-1].sum(dtype=np.float64))

    def assign(self, leaf: Rows, value: Array) -> None:
        """Set leaves, ``[B]``; where one is named twice, the last value counts."""
        self._levels[0][leaf] = value
        for below, level in zip(self._levels, self._levels[1:], strict=False):
            leaf = leaf // _FAN_OUT
            level[leaf] = below.reshape(-1, _FAN_OUT).take(leaf, axis=0) @ _ONES

    def assign_range(self, begin: int, end: int, value: float) -> None:
        """Set the leaves from ``begin`` to below ``end``."""
        self._levels[0][begin:end] = value
        for below, level in zip(self._levels, self._levels[1:], strict=False):
            begin, end = begin // _FAN_OUT, -(-end // _FAN_OUT)
            children = below[begin * _FAN_OUT : end * _FAN_OUT].reshape(-1, _FAN_OUT)
            level[begin:end] = children @ _ONES

    def draw(self, batch_size: int, rng: np.random.Generator) -> Rows:
        """Draw leaves, one from each of ``batch_size`` equal shares of the total.

        The total must be positive.

        Returns:
            Their indices, int64 ``[B]``; a leaf of 0 is never among them.
        """
        share = np.arange(batch_size) + rng.random(batch_size)
        leaf = self._find(share / batch_size)
        while (empty := self.leaves.take(leaf) <= 0.0).any():  # only by rounding
            leaf[empty] = self._find(rng.random(int(empty.sum())))
        return leaf

    def _find(self, quantile: Floats) -> Rows:
        """Find the leaf at each quantile of the total, ``[B]``."""
        roots = self._levels[-1]
        upto = roots.cumsum(dtype=np.float64)
        rest = np.minimum(quantile * upto[-1], np.nextafter(upto[-1], 0.0))
        node: Rows = upto.searchsorted(rest, side="right")
        left = (rest - upto.take(node)).astype(np.float32) + roots.take(node)
        first = np.arange(len(node)) * _FAN_OUT
        for level in self._levels[-2::-1]:
            children = level.reshape(-1, _FAN_OUT).take(node, axis=0)
            prefix = children @ _PREFIX
            child = (prefix > left[:, None]).argmax(axis=1)
            node = node * _FAN_OUT + child
            if level is not self._levels[0]:
                place = first + child
                left -= prefix.ravel().take(place) - children.ravel().take(place)
        return node


def _padded(level: Array) -> Array:
    """Fill up with zeros to whole families."""
    return np.pad(level, (0, -len(level) % _FAN_OUT)).astype(np.float32)
