"""The latest batches, from which Q learns."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from a2s.learner.on_policy.batch import Batch

_PREFIX = "window."
_FIELDS = tuple(Batch.__slots__)

Kept = tuple[tuple[int, Batch], ...]  # batches with their numbers, the newest last


class Window:
    """The newest batches: as few whole ones as hold ``steps`` steps."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.kept: Kept = ()

    def add(self, batch: Batch) -> None:
        """Take a batch in, and forget those that are too old."""
        number = self.kept[-1][0] + 1 if self.kept else 0
        kept = [*self.kept, (number, batch)]
        total = sum(each.num_steps for _, each in kept)
        while total - kept[0][1].num_steps >= self.steps:
            total -= kept.pop(0)[1].num_steps
        self.kept = tuple(kept)

    def joined(self) -> Batch:
        """All of them as one, the newest last."""
        batches = [batch for _, batch in self.kept]
        return Batch(**{name: torch.cat([getattr(b, name) for b in batches]) for name in _FIELDS})


def window_tensors(*windows: Kept) -> dict[str, Tensor]:
    """The tensors of windows by name; a batch that several hold is there once."""
    batches = dict(pair for window in windows for pair in window)
    return {
        f"{_PREFIX}{number}.{name}": getattr(batch, name)
        for number, batch in batches.items()
        for name in _FIELDS
    }


def is_of_window(name: str) -> bool:
    """Whether a tensor's name is one of `window_tensors`."""
    return name.startswith(_PREFIX)


def stored_window(tensors: Mapping[str, Any], numbers: Sequence[int]) -> Kept:
    """The window of those numbers out of `window_tensors`."""
    return tuple(
        (number, Batch(**{name: tensors[f"{_PREFIX}{number}.{name}"] for name in _FIELDS}))
        for number in numbers
    )
