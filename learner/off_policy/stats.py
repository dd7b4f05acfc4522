"""Numbers that say how an off-policy update went, and their means over a round of updates."""

from collections import Counter
from typing import NamedTuple

import torch
from torch import Tensor


class OffPolicyStats(NamedTuple):
    """Numbers of one update, still on the device.

    Attributes:
        q_loss: Of the critics, summed over them, in units of `ReturnSize`, ``[]``.
        policy_loss: Of the policy gradient, in the same units, ``[]``; None if it did not learn.
        q_mean: Mean of the critics on the batch before the update, in returns, ``[]``.
        target_mean: Mean of the targets, in returns, ``[]``.
        entropy: Of the policy, estimated from one suggestion a state, nats, ``[]``, or None too.
        temperature: Weight of the entropy after the update, in returns, ``[]``.
        error: Absolute error of every row, in returns, for priorities, ``[B]``.
    """

    q_loss: Tensor
    policy_loss: Tensor | None
    q_mean: Tensor
    target_mean: Tensor
    entropy: Tensor | None
    temperature: Tensor
    error: Tensor


SHOWN = tuple(name for name in OffPolicyStats._fields if name != "error")


class RoundMeans:
    """Means over the updates of a round, added up without waiting for the device.

    Attributes:
        counts: Updates so far that had a number of this name.
    """

    def __init__(self) -> None:
        self.counts = Counter[str]()
        self._totals: dict[str, Tensor] = {}

    @property
    def updates(self) -> int:
        """Updates so far."""
        return self.counts["q_loss"]

    def add(self, stats: OffPolicyStats) -> None:
        """Take an update into account."""
        for name in SHOWN:
            value = getattr(stats, name)
            if value is not None:
                self._totals[name] = self._totals.get(name, 0.0) + value
                self.counts[name] += 1

    def means(self) -> dict[str, float | None]:
        """By the names of `SHOWN`; None where no update had one."""
        found: dict[str, float | None] = dict.fromkeys(SHOWN)
        if self._totals:
            totals = torch.stack([*self._totals.values()]).tolist()
            for name, total in zip(self._totals, totals, strict=True):
                found[name] = total / self.counts[name]
        return found
