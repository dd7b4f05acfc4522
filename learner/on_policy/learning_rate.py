"""The policy's learning rate: constant, annealed, or following the KL divergence."""

from a2s.learner.on_policy.config import LearningRateRule

FACTOR = 1.5


class LearningRate:
    """The learning rate, and what it is adapted to.

    The rule ``kl`` divides by 1.5 when the last update moved more than twice the target and
    multiplies by 1.5 when it moved less than half of it. The other two return by factors of 1.5
    to their first value after a recovery has cut it.

    ``kl_target`` and ``last_kl`` are the wanted KL divergence of an update and the last one, nats.
    ``low`` bounds the rule ``kl`` and what a recovery leaves, ``high`` the rule ``kl``.

    Source: section 4.1.1 of the paper ("adapt the learning rate to keep the KL-divergence around
    a desired value"), factors as in the authors' code.
    """

    def __init__(
        self,
        *,
        rule: LearningRateRule,
        first: float,
        kl_target: float,
        recovery_divisor: float,
        low: float,
        high: float,
    ) -> None:
        self._rule = rule
        self._first = self._now = first
        self._divisor, self._low, self._high = recovery_divisor, low, high
        self.kl_target = kl_target
        self.last_kl = 0.0

    def adapt(self) -> None:
        """Apply the rule to the last divergence measured."""
        if self._rule != "kl":
            self._now = min(self._now * FACTOR, self._first)
            return
        if self.last_kl > 2.0 * self.kl_target:
            self._now /= FACTOR
        elif self.last_kl < 0.5 * self.kl_target:
            self._now *= FACTOR
        self._now = min(max(self._now, self._low), self._high)

    def at(self, progress: float) -> float:
        """The learning rate when a fraction of the run, 0..1, is done."""
        return self._now * self.left(progress)

    def left(self, progress: float) -> float:
        """What annealing leaves of any learning rate."""
        return 1.0 - progress if self._rule == "anneal" else 1.0

    def after_recovery(self) -> None:
        """Step more carefully, and forget the divergence of the failed update."""
        self._now = max(self._now / self._divisor, self._low)
        self.last_kl = self.kl_target

    def state(self) -> dict[str, float]:
        """All that changes."""
        return {"learning_rate": self._now, "kl_target": self.kl_target, "last_kl": self.last_kl}

    def load(self, state: dict[str, float]) -> None:
        """Go back to a state."""
        self._now = state["learning_rate"]
        self.kl_target, self.last_kl = state["kl_target"], state["last_kl"]
