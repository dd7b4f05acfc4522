"""How large the next update may be: KL divergence, and the learning rate that follows it."""

import torch
from torch import Tensor

from a2s.learner.on_policy.config import OnPolicyConfig

FACTOR = 1.5


def gaussian_kl(mean: Tensor, log_std: Tensor, old_mean: Tensor, old_log_std: Tensor) -> Tensor:
    """KL(new || old) of diagonal Gaussians in nats, by dimension.

    Args:
        mean: Of the new ones, ``[N, A]``.
        log_std: Of the new ones, ``[A]``.
        old_mean: ``[N, A]``.
        old_log_std: ``[A]``.

    Returns:
        ``[N, A]``; the sum over A is the divergence of the joint densities.
    """
    change = log_std - old_log_std
    apart = ((mean - old_mean) * (-old_log_std).exp()).square()
    return 0.5 * (torch.expm1(2.0 * change) + apart) - change


class StepSize:
    """The learning rates, and what they are adapted to.

    The rule ``kl`` divides by 1.5 when the last update moved more than twice the target and
    multiplies by 1.5 when it moved less than half of it. The other two return by factors of 1.5
    to their first value after a recovery has cut it.

    Source: section 4.1.1 of the paper ("adapt the learning rate to keep the KL-divergence around
    a desired value"), factors as in the authors' code; differs: clamped.
    """

    def __init__(self, hyper: OnPolicyConfig) -> None:
        self._hyper = hyper
        self._learning_rate = hyper.learning_rate
        self.kl_target = hyper.kl_target
        self.last_kl = 0.0

    def adapt(self, progress: float) -> tuple[float, float]:
        """Apply the rule to the last divergence measured.

        Args:
            progress: Fraction of the run that is done, 0..1.

        Returns:
            Learning rates of the policy, and of Q and V.
        """
        hyper, rate = self._hyper, self._learning_rate
        if hyper.lr_rule == "kl":
            if self.last_kl > 2.0 * self.kl_target:
                rate /= FACTOR
            elif self.last_kl < 0.5 * self.kl_target:
                rate *= FACTOR
            rate = min(max(rate, hyper.lr_min), hyper.lr_max)
        else:
            rate = min(rate * FACTOR, hyper.learning_rate)
        self._learning_rate = rate
        return self.rates(progress)

    def rates(self, progress: float) -> tuple[float, float]:
        """Learning rates of the policy, and of Q and V, as they stand."""
        hyper = self._hyper
        left = 1.0 - progress if hyper.lr_rule == "anneal" else 1.0
        ratio = self._learning_rate / hyper.learning_rate if hyper.critic_follows_rule else 1.0
        return self._learning_rate * left, hyper.critic_learning_rate * ratio * left

    def after_recovery(self) -> None:
        """Step more carefully, and forget the divergence of the failed update."""
        hyper = self._hyper
        self._learning_rate = max(self._learning_rate / hyper.recovery_lr_divisor, hyper.lr_min)
        self.kl_target /= hyper.recovery_kl_divisor
        self.last_kl = self.kl_target

    def state(self) -> dict[str, float]:
        """All that changes."""
        return {
            "learning_rate": self._learning_rate,
            "kl_target": self.kl_target,
            "last_kl": self.last_kl,
        }

    def load(self, state: dict[str, float]) -> None:
        """Go back to a state."""
        self._learning_rate = state["learning_rate"]
        self.kl_target = state["kl_target"]
        self.last_kl = state["last_kl"]
