"""The interface between ingest and the place where accepted segments go."""

from typing import NamedTuple, Protocol

from a2s.protocol.messages import Segment


class Quota(NamedTuple):
    """Steps of a batch, and the share of every environment: steps and whole episodes."""

    batch_steps: int
    steps: int
    episodes: int


class Store(Protocol):
    """The destination of accepted segments; a variant learns from nothing else.

    Attributes:
        max_policy_lag: Versions that a segment may be behind; ``None``: any number.
        max_suggestion: Largest absolute value in a suggestion.
        short_steps: Steps of the short episodes that are wanted (docs/adr/0038); 0: none.
    """

    max_policy_lag: int | None
    max_suggestion: float
    short_steps: int

    def quota(self, num_envs: int) -> Quota:
        """The next quota of ``num_envs`` environments."""
        ...

    def store(self, slot: int, segment: Segment) -> None:
        """Take a segment, before it is acknowledged.

        Raises:
            RunDirectoryError: It cannot be written.
        """
        ...

    def close_batch(self) -> None:
        """Learn next from the steps stored so far; later ones are for the batch after."""
        ...

    def hold_s(self, num_batches: float) -> float:
        """Seconds that actors should wait because learning is behind by this number of batches."""
        ...
