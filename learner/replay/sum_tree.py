"""Drawing in proportion to priorities: a tree of sums, every level handled for a whole batch.

Sixteen children a node: with numpy the price is per level, and a level of sixteen costs hardly
more than one of two (docs/adr/0005). A node is always the sum of its children, computed anew, so
rounding does not build up.
"""

import numpy as np
import numpy.typing as npt

from a2s.learner.replay.transitions import Rows

Floats = npt.NDArray[np.float64]

_FAN_OUT = 16
_MOST_ROOTS = 8192
_ONES = np.ones(_FAN_OUT)
_PREFIX = np.triu(np.ones((_FAN_OUT, _FAN_OUT)))


class SumTree:
    """Non-negative leaves, drawn with a chance in proportion to each.

    Args:
        leaves: Their values, float64 ``[N]``.
    """

    def __init__(self, leaves: Floats) -> None:
        level = np.zeros(-(-len(leaves) // _FAN_OUT) * _FAN_OUT)
        level[: len(leaves)] = leaves
        self._levels = [level]
        while len(level) > _MOST_ROOTS:
            above = level.reshape(-1, _FAN_OUT) @ _ONES
            level = np.zeros(-(-len(above) // _FAN_OUT) * _FAN_OUT)
            level[: len(above)] = above
            self._levels.append(level)

    @property
    def leaves(self) -> Floats:
        """The values, float64 ``[N]`` and some zeros behind them; not to be written to."""
        return self._levels[0]

    @property
    def total(self) -> float:
        """Sum of all leaves."""
        return float(self._levels[-1].sum())

    def assign(self, leaf: Rows, value: Floats | float) -> None:
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
            level[begin:end] = (
                below[begin * _FAN_OUT : end * _FAN_OUT].reshape(-1, _FAN_OUT) @ _ONES
            )

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
        upto = roots.cumsum()
        rest = np.minimum(quantile * upto[-1], np.nextafter(upto[-1], 0.0))
        node: Rows = upto.searchsorted(rest, side="right")
        rest -= upto.take(node) - roots.take(node)
        first = np.arange(len(node)) * _FAN_OUT
        for level in self._levels[-2::-1]:
            children = level.reshape(-1, _FAN_OUT).take(node, axis=0)
            upto = children @ _PREFIX
            child = (upto > rest[:, None]).argmax(axis=1)
            place = first + child
            rest -= upto.ravel().take(place) - children.ravel().take(place)
            node = node * _FAN_OUT + child
        return node
