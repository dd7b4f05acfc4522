"""What is shown of off-policy updates: means over a round, by the names of `OffPolicyStats`."""

import torch
from torch import Tensor

from a2s.learner.off_policy.update import OffPolicyStats

SHOWN = tuple(name for name in OffPolicyStats._fields if name != "error")


class RoundMeans:
    """Adds up the updates of a round without waiting for the device.

    Attributes:
        count: Updates so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._total: Tensor | float = 0.0

    def add(self, stats: OffPolicyStats) -> None:
        """Take an update into account."""
        self._total = self._total + torch.stack([getattr(stats, name) for name in SHOWN])
        self.count += 1

    def means(self) -> dict[str, float]:
        """By name; there was at least one update."""
        assert isinstance(self._total, Tensor)
        return dict(zip(SHOWN, (self._total / self.count).tolist(), strict=True))
