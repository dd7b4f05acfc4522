"""How a transition lies in a row: one stretch of float32, so that sampling touches memory once."""

from dataclasses import dataclass

import numpy as np

from a2s.protocol.messages import Array

ITEM_BYTES = np.dtype(np.float32).itemsize


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a row: ``obs [D] action [A] next_obs [D] reward terminated truncated``.

    Attributes:
        obs_size: D.
        action_size: A.
    """

    obs_size: int
    action_size: int

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return 2 * self.obs_size + self.action_size + 3

    def obs(self, rows: Array) -> Array:
        """Observation before the step, ``[..., D]``."""
        return rows[..., : self.obs_size]

    def action(self, rows: Array) -> Array:
        """Executed suggestion, ``[..., A]``."""
        return rows[..., self.obs_size : self.obs_size + self.action_size]

    def next_obs(self, rows: Array) -> Array:
        """Observation after the step, of the same episode, ``[..., D]``."""
        return rows[..., self.obs_size + self.action_size : -3]

    def reward(self, rows: Array) -> Array:
        """Reward of the step, ``[...]``."""
        return rows[..., -3]

    def terminated(self, rows: Array) -> Array:
        """1 where the step reached a terminal state, else 0, ``[...]``."""
        return rows[..., -2]

    def truncated(self, rows: Array) -> Array:
        """1 where the step hit a time limit, else 0, ``[...]``."""
        return rows[..., -1]
