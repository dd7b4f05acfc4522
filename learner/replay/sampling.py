"""Sampling a replay: uniform and prioritised draws of rows, and transitions over n steps.

Source: Schaul et al. 2016, "Prioritized Experience Replay" (arXiv:1511.05952), sections 3.3 and
3.4, proportional variant. Differs: weights are divided by the highest of the batch.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from a2s.learner.replay.ring import Floats, Ring
from a2s.learner.replay.ring import Rows as Rows  # with `Transitions`
from a2s.protocol.fields import Array

if TYPE_CHECKING:
    from a2s.learner.replay.sum_tree import SumTree

_EPSILON = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Transitions:
    """A batch of transitions, each over up to n steps of one episode.

    The target of a value at ``(obs, action)`` is ``reward + discount * value(next_obs)``.

    Attributes:
        obs: Observation before the first step, float32 ``[B, D]``.
        action: The first step's executed suggestion, canonical, not clipped, float32 ``[B, A]``.
        reward: Discounted sum of the rewards of the steps, float32 ``[B]``.
        next_obs: Observation after the last step, of the same episode, float32 ``[B, D]``.
        discount: gamma to the number of steps; 0 where the last one terminated, float32 ``[B]``.
        weight: Importance weight, highest of the batch 1; all 1 when drawn uniformly,
            float32 ``[B]``.
        row: Number of the first step's row, counted from the first ever inserted, int64 ``[B]``.
        begin: Number of the oldest row when it was drawn.
        end: Number of the row that was to come next.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    discount: Array
    weight: Array
    row: Rows
    begin: int
    end: int


def joined(first: Transitions, second: Transitions) -> Transitions:
    """Put the transitions of two replays below each other; ``row`` and its range are the first's.

    So ``row``, int64 ``[B1]``, is shorter than the other columns, ``[B1 + B2, ...]``.
    """
    return replace(
        first,
        obs=np.concatenate([first.obs, second.obs]),
        action=np.concatenate([first.action, second.action]),
        reward=np.concatenate([first.reward, second.reward]),
        next_obs=np.concatenate([first.next_obs, second.next_obs]),
        discount=np.concatenate([first.discount, second.discount]),
        weight=np.concatenate([first.weight, second.weight]),
    )


def draw_uniform(ring: Ring, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Array]:
    """Draw live rows with replacement, int64 ``[B]``; their weights, float32 ``[B]``, are 1."""
    row = ring.begin + (rng.random(batch_size) * len(ring)).astype(np.int64)
    return row, np.ones(batch_size, np.float32)


class Priorities:
    """The priority of every slot of a ring, and draws in proportion to it.

    There is no tree until the first draw: uniform sampling does not pay for one. Priorities have
    no checksum: a value that is not a number of 0 or more counts as 1. They lie in ``priority``,
    float32 ``[S]``. The exponent ``alpha`` is 0 for uniform draws, 1 for fully proportional ones.
    ``highest`` is the priority of a new row: the highest so far, at least 1.
    """

    def __init__(self, ring: Ring, priority: Array, alpha: float) -> None:
        self._ring = ring
        self._priority = priority
        self._alpha = alpha
        self._tree: SumTree | None = None
        slots = self._live_slots()
        found = priority[slots]
        bad = ~(np.isfinite(found) & (found >= 0))
        if bad.any():
            priority[slots[bad]] = 1.0
        self.highest = max(1.0, float(priority[slots].max(initial=0.0)))

    def admit(self, begin: int, end: int) -> None:
        """Give new rows, which lie in one stretch, the highest priority so far."""
        slot = begin % len(self._priority)
        self._priority[slot : slot + end - begin] = self.highest
        if self._tree is not None:
            value = float(self._leaf(np.array([self.highest], np.float32))[0])
            self._tree.assign_range(slot, slot + end - begin, value)

    def evict(self, begin: int, end: int) -> None:
        """Draw the rows from ``begin`` to below ``end`` no more."""
        if self._tree is None:
            return
        first = begin % self._ring.size
        wrapped = max(0, first + end - begin - self._ring.size)
        self._tree.assign_range(first, first + end - begin - wrapped, 0.0)
        if wrapped:
            self._tree.assign_range(0, wrapped, 0.0)

    def draw(self, batch_size: int, beta: float, rng: np.random.Generator) -> tuple[Rows, Array]:
        """Draw live rows with replacement, int64 ``[B]``.

        Their weights are ``(chance * len(ring)) ** -beta`` over the highest, float32 ``[B]``.
        """
        if self._tree is None:
            from a2s.learner.replay.sum_tree import SumTree  # numba takes half a second

            slots = self._live_slots()
            leaves = np.zeros_like(self._priority)
            leaves[slots] = self._leaf(self._priority[slots])
            self._tree = SumTree(leaves)
        slot = self._tree.draw(batch_size, rng)
        leaf = self._tree.leaves.take(slot)
        weight = (leaf / leaf.min()) ** np.float32(-beta)
        newest = self._ring.end - 1
        return newest - (newest - slot) % len(self._priority), weight

    def assign(self, row: Rows, priority: Floats, highest: float) -> None:
        """Set the priorities of live rows, ``[B]``, of which the highest is ``highest``."""
        slot = row % len(self._priority)
        self.highest = max(self.highest, highest)
        rounded = priority.astype(np.float32)  # as a resumed run will read it
        self._priority[slot] = rounded
        if self._tree is not None:
            self._tree.assign(slot, self._leaf(rounded))

    def _live_slots(self) -> Rows:
        return self._ring.slot(np.arange(self._ring.begin, self._ring.end))

    def _leaf(self, priority: Array) -> Array:
        leaf: Array = (priority + np.float32(_EPSILON)) ** np.float32(self._alpha)
        return leaf


def gather(ring: Ring, row: Rows, weight: Array, n_step: int, gamma: float) -> Transitions:
    """Read the transitions that begin at live rows."""
    slots = ring.slots
    first = last = ring.slot(row)
    outcome = slots.outcome.take(first, axis=0)
    reward, discount = outcome[:, 0], np.float32(gamma) * outcome[:, 1]
    if n_step > 1:
        last, reward, discount = _add_up(ring, row, reward, n_step, gamma)
    return Transitions(
        obs=slots.obs.take(first, axis=0),
        action=slots.action.take(first, axis=0),
        reward=reward,
        next_obs=slots.next_obs.take(last, axis=0),
        discount=discount,
        weight=weight,
        row=row,
        begin=ring.begin,
        end=ring.end,
    )


def _add_up(
    ring: Ring, row: Rows, reward: Array, n_step: int, gamma: float
) -> tuple[Rows, Array, Array]:
    """Follow episodes for n steps: last slots, discounted sums of rewards, discounts."""
    discounts = (gamma ** np.arange(n_step + 1)).astype(np.float32)
    steps = np.ones(len(row), np.int64)
    total = reward.copy()
    for k in range(1, n_step):
        following = ring.follow(row)
        goes_on = following > row
        if not goes_on.any():
            break
        row = following
        reward = ring.slots.outcome[ring.slot(row), 0]
        total += np.where(goes_on, discounts[k] * reward, np.float32(0.0))
        steps += goes_on
    slot = ring.slot(row)
    return slot, total, discounts[steps] * ring.slots.outcome[slot, 1]
