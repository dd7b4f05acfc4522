"""Prioritised replay: which rows are drawn more often, and by how much less they count then.

Source: Schaul et al. 2016, "Prioritized Experience Replay" (arXiv:1511.05952), section 3.3 and
3.4, proportional variant. Differs: weights are divided by the highest of the batch.
"""

from typing import TYPE_CHECKING

import numpy as np

from a2s.learner.replay.transitions import Floats, Rows
from a2s.protocol.fields import Array

if TYPE_CHECKING:
    from a2s.learner.replay.sum_tree import SumTree

_EPSILON = 1e-6


class Priorities:
    """The priority of every slot of a ring, and draws in proportion to it.

    Nothing but the array is kept up to date until the first draw: whoever draws uniformly does not
    pay for a tree.

    Args:
        priority: Where they lie, float32 ``[S]`` for S slots.
        alpha: Exponent: 0 is uniform, 1 fully proportional.

    Attributes:
        highest: What a new row gets: the highest priority so far, at least 1.
    """

    def __init__(self, priority: Array, alpha: float) -> None:
        self._priority = priority
        self._alpha = alpha
        self._tree: SumTree | None = None
        self.highest = 1.0

    def restore(self, begin: int, end: int) -> None:
        """Take up the priorities of the rows from ``begin`` to below ``end``.

        What is not a number above 0 counts as 1: priorities have no checksum.
        """
        slots = np.arange(begin, end) % len(self._priority)
        found = self._priority[slots]
        bad = ~(np.isfinite(found) & (found >= 0))
        if bad.any():
            self._priority[slots[bad]] = 1.0
        self.highest = max(1.0, float(self._priority[slots].max(initial=0.0)))

    def admit(self, begin: int, end: int) -> None:
        """Give new rows, which lie in one stretch, the highest priority so far."""
        slot = begin % len(self._priority)
        self._priority[slot : slot + end - begin] = self.highest
        if self._tree is not None:
            value = float(self._leaf(np.array([self.highest], np.float32))[0])
            self._tree.assign_range(slot, slot + end - begin, value)

    def evict(self, begin: int, end: int) -> None:
        """Rows from ``begin`` to below ``end`` can no longer be drawn."""
        if self._tree is None or begin == end:
            return
        size = len(self._priority)
        first, last = begin % size, (end - 1) % size + 1
        if first < last:
            self._tree.assign_range(first, last, 0.0)
        else:
            self._tree.assign_range(first, size, 0.0)
            self._tree.assign_range(0, last, 0.0)

    def draw(
        self, begin: int, end: int, batch_size: int, beta: float, rng: np.random.Generator
    ) -> tuple[Rows, Array]:
        """Draw from the live rows, ``begin`` to below ``end``.

        Args:
            begin: The oldest.
            end: The newest and one.
            batch_size: B.
            beta: How far the weights make up for the uneven draw: 0 not, 1 fully.
            rng: Source of the draw.

        Returns:
            Rows, int64 ``[B]``, and their weights ``(chance * (end - begin)) ** -beta``, divided
            by the highest, float32 ``[B]``.
        """
        size = len(self._priority)
        if self._tree is None:
            slots = np.arange(begin, end) % size
            leaves = np.zeros(size, np.float32)
            leaves[slots] = self._leaf(self._priority[slots])
            from a2s.learner.replay.sum_tree import SumTree  # half a second: only who needs it

            self._tree = SumTree(leaves)
        slot = self._tree.draw(batch_size, rng)
        leaf = self._tree.leaves.take(slot)
        weight = (leaf / leaf.min()) ** np.float32(-beta)
        return end - 1 - (end - 1 - slot) % size, weight

    def assign(self, row: Rows, priority: Floats, highest: float) -> None:
        """Set the priorities of live rows, ``[B]``, for example their absolute TD errors.

        Args:
            row: The rows.
            priority: Theirs.
            highest: What a new row gets, if no higher one was given before.
        """
        slot = row % len(self._priority)
        self.highest = max(self.highest, highest)
        rounded = priority.astype(np.float32)  # as a resumed run will read it
        self._priority[slot] = rounded
        if self._tree is not None:
            self._tree.assign(slot, self._leaf(rounded))

    def _leaf(self, priority: Array) -> Array:
        leaf: Array = (priority + np.float32(_EPSILON)) ** np.float32(self._alpha)
        return leaf
