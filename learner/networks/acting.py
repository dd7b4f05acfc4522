"""The answer of suggesters, and the conversion of canonical actions to the environment's."""

from typing import NamedTuple

from torch import Tensor


class Choice(NamedTuple):
    """The answer of a suggester.

    Attributes:
        action: In the environment's units and within its bounds, float32 ``[B, A]``.
        suggestion: The chosen one, canonical, before clipping, float32 ``[B, A]``.
        log_prob: Its log density as executed, float32 ``[B]``: under the policy, and where it was
            drawn among K also by that selection.
        q_spread: Largest score less the mean over the K suggestions, in returns, float32 ``[B]``.
    """

    action: Tensor
    suggestion: Tensor
    log_prob: Tensor
    q_spread: Tensor


class ActionBounds:
    """Lowest and highest action of an environment, float32 ``[A]``; -1..1 canonical spans them."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        self.low, self.high = low.float(), high.float()
        self.half_range = (self.high - self.low) / 2
        self.centre = (self.high + self.low) / 2

    def to_env(self, canonical: Tensor) -> Tensor:
        """Actions in the environment's units, within the bounds: ``[B, A]``."""
        return (canonical * self.half_range + self.centre).clamp(self.low, self.high)
