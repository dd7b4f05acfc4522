"""How transitions lie in memory: four columns, written by stretches and read by single rows."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import xxhash

from a2s.protocol.fields import Array, Spaces


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Transitions in S slots, all float32 and contiguous.

    Attributes:
        obs: Observation before the step, ``[S, D]``.
        action: Executed suggestion, ``[S, A]``.
        next_obs: Observation after the step, of the same episode, ``[S, D]``.
        outcome: Reward, and 0 where the step terminated the episode, else 1, ``[S, 2]``.
    """

    obs: Array
    action: Array
    next_obs: Array
    outcome: Array

    @classmethod
    def make(
        cls, spaces: Spaces, num_slots: int, make: Callable[[str, tuple[int, int]], Array]
    ) -> Self:
        """Make every column by its name and shape."""
        size, action_size = spaces.obs_size, spaces.action_size
        widths = {"obs": size, "action": action_size, "next_obs": size, "outcome": 2}
        return cls(**{name: make(name, (num_slots, width)) for name, width in widths.items()})

    def __len__(self) -> int:
        return len(self.outcome)

    def stretch(self, slot: int, count: int) -> "Columns":
        """Look at successive slots."""
        end = slot + count
        return Columns(
            self.obs[slot:end], self.action[slot:end], self.next_obs[slot:end],
            self.outcome[slot:end],
        )  # fmt: skip

    def copy(self, other: "Columns") -> None:
        """Copy as many transitions from somewhere else."""
        for column in fields(self):
            getattr(self, column.name)[:] = getattr(other, column.name)

    def checksum(self) -> int:
        """XXH3, 64 bits, of all bytes, column by column."""
        digest = xxhash.xxh3_64()
        for column in (self.obs, self.action, self.next_obs, self.outcome):
            digest.update(column.data.cast("B"))
        return digest.intdigest()


def in_memory(name: str, shape: tuple[int, int]) -> Array:
    """Make a column that dies with this process."""
    del name
    return np.zeros(shape, np.float32)
