"""The policy's learning rate: constant, annealed, or following the KL divergence."""

from dataclasses import dataclass, field

from a2s.learner.on_policy.config import LearningRateRule

FACTOR = 1.5


@dataclass(slots=True, kw_only=True)
class LearningRate:
    """The learning rate, and what it is adapted to.

    The rule ``kl`` divides by 1.5 when the last update moved more than twice the target and
    multiplies by 1.5 when it moved less than half of it. The other two return by factors of 1.5
    to their first value after a recovery has cut it.

    Source: section 4.1.1 of the paper ("adapt the learning rate to keep the KL-divergence around
    a desired value"), factors as in the authors' code.
    """

    rule: LearningRateRule
    first: float
    kl_target: float  # wanted divergence of an update, nats
    recovery_divisor: float
    low: float  # least rate after a recovery and of the rule `kl`
    high: float  # greatest rate of the rule `kl`
    last_kl: float = field(default=0.0, init=False)  # divergence of the last update, nats
    _now: float = field(init=False)

    def __post_init__(self) -> None:
        """Begin with the first rate."""
        self._now = self.first

    def adapt(self) -> None:
        """Apply the rule to the last divergence measured."""
        if self.rule != "kl":
            self._now = min(self._now * FACTOR, self.first)
            return
        if self.last_kl > 2.0 * self.kl_target:
            self._now /= FACTOR
        elif self.last_kl < 0.5 * self.kl_target:
            self._now *= FACTOR
        self._now = min(max(self._now, self.low), self.high)

    def at(self, progress: float) -> float:
        """The learning rate when a fraction of the run, 0..1, is done."""
        return self._now * self.left(progress)

    def left(self, progress: float) -> float:
        """What annealing leaves of any learning rate."""
        return 1.0 - progress if self.rule == "anneal" else 1.0

    def after_recovery(self) -> None:
        """Step more carefully, and forget the divergence of the failed update."""
        self._now = max(self._now / self.recovery_divisor, self.low)
        self.last_kl = self.kl_target

    def state(self) -> dict[str, float]:
        """All that changes."""
        return {"learning_rate": self._now, "kl_target": self.kl_target, "last_kl": self.last_kl}

    def load(self, state: dict[str, float]) -> None:
        """Go back to a state."""
        self._now = state["learning_rate"]
        self.kl_target, self.last_kl = state["kl_target"], state["last_kl"]
