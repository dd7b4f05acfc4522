"""The interface between the learner's loop and a variant of the algorithm."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from a2s.learner.on_policy.recovery import RecoveryDecision

Saved = tuple[dict[str, Tensor], dict[str, Any]]


class Outcome(NamedTuple):
    """The result of learning from a batch.

    Attributes:
        row: For ``updates.csv``, the variant's own columns.
        kl: How far the policy moved, nats; ``None`` where it is not measured.
        decision: The test of equation 5; ``None`` where recovery is off.
        restored_version: Version of the networks that were restored; -1 if nothing was restored.
    """

    row: Mapping[str, object]
    kl: float | None = None
    decision: RecoveryDecision | None = None
    restored_version: int = -1

    @property
    def recovered(self) -> bool:
        """Whether the best networks were restored."""
        return self.restored_version >= 0


class Trainer(Protocol):
    """A variant: it makes graphs to act by, and learns from what was stored.

    Attributes:
        columns: Of ``updates.csv``, its own ones.
        overlaps_learning: In lockstep, actors play the next batch while this one is learned from.
    """

    columns: tuple[str, ...]
    overlaps_learning: bool

    @property
    def updates(self) -> int:
        """Updates made."""
        ...

    def graph(self, version: int, progress: float, *, averaged: bool = False) -> bytes:
        """The present way of acting as ONNX bytes, at a fraction of the run.

        Where it can, the ``averaged`` one is steadier than what actors are to play.
        """
        ...

    def learn(self, progress: float) -> Outcome:
        """Learn after a batch was stored.

        Raises:
            A2SError: The networks are no longer finite, or the replay cannot be reached.
        """
        ...

    def state(self) -> Saved:
        """Tensors, and numbers that survive JSON: everything that going on from here needs."""
        ...

    def begin_with(self, saved: Saved, taken: Sequence[str]) -> None:
        """Take parts of another run's `state`: networks and ``normaliser``, by name."""
        ...

    def close(self) -> None:
        """Close files."""
        ...
