"""What the learner's loop asks of a variant of the algorithm."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from a2s.learner.on_policy.recovery import RecoveryDecision
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Segment
from a2s.protocol.transport import Bus


class Quota(NamedTuple):
    """What is played with one version of the weights.

    Attributes:
        batch_steps: Environment steps of the next batch.
        steps: Share of every environment, steps.
        episodes: Share of every environment, whole episodes.
    """

    batch_steps: int
    steps: int
    episodes: int


class Outcome(NamedTuple):
    """What came of learning from a batch.

    Attributes:
        row: For ``updates.csv``, the variant's own columns.
        kl: How far the policy moved, nats; ``None`` where it is not measured.
        decision: The test of equation 5; ``None`` where recovery is off.
        restored_version: Version of the networks that were restored, -1 if none were.
    """

    row: Mapping[str, object]
    kl: float | None = None
    decision: RecoveryDecision | None = None
    restored_version: int = -1

    @property
    def recovered(self) -> bool:
        """Whether the best networks were restored."""
        return self.restored_version >= 0


Saved = tuple[dict[str, Tensor], dict[str, Any]]


class Learning(Protocol):
    """A variant: it makes graphs to act by, and learns from what was played.

    Attributes:
        columns: Of ``updates.csv``, its own ones.
        max_policy_lag: Versions that a segment may be behind; ``None``: any number.
        most_suggested: Size of the numbers of a suggestion.
        plays_on: In lockstep, actors play the next batch while this one is learned from.
    """

    columns: tuple[str, ...]
    max_policy_lag: int | None
    most_suggested: float
    plays_on: bool

    @property
    def updates(self) -> int:
        """Updates made."""
        ...

    def quota(self, num_envs: int) -> Quota:
        """What to play next with so many environments."""
        ...

    def graph(
        self, version: int, progress: float, metadata: Mapping[str, str], *, to_keep: bool = False
    ) -> bytes:
        """The present way of acting as ONNX bytes.

        Args:
            version: Its ``weights_version``.
            progress: Fraction of the run that is done.
            metadata: Goes into the file.
            to_keep: What is kept for use, which may be steadier than what actors are to play.
        """
        ...

    def keep(self, segment: Segment) -> None:
        """Store a segment before it is acknowledged, where the variant stores any.

        Raises:
            RunDirectoryError: It cannot be written.
        """
        ...

    def hold_s(self, pending_batches: float) -> float:
        """Seconds that actors should wait because learning is behind; asked in ``async``.

        Args:
            pending_batches: Batches that wait to be learned from, in steps of the quota.
        """
        ...

    def learn(self, segments: Sequence[Segment], progress: float, *, is_behind: bool) -> Outcome:
        """Learn after a batch was played, by networks one update older when ``is_behind``.

        Raises:
            A2SError: The networks are no longer finite.
        """
        ...

    def state(self) -> Saved:
        """Tensors, and numbers that survive JSON: everything that going on from here needs."""
        ...

    def serve(self, bus: Bus, keys: Keys, generation: int) -> None:
        """Answer on the network what others may ask of this variant alone."""
        ...

    def close(self) -> None:
        """Close files."""
        ...
