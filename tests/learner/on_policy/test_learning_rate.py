"""The learning rate that follows the KL divergence, or time."""

import math
from typing import Any

import pytest

from a2s.learner.on_policy.learning_rate import LearningRate


def make(rule: Any, **options: float) -> LearningRate:
    """A rate of 3e-4 that is halved by a recovery."""
    values = {
        "first": 3e-4, "kl_target": 0.01, "recovery_divisor": 2.0, "low": 0.0, "high": math.inf,
    }  # fmt: skip
    return LearningRate(rule=rule, **(values | options))


@pytest.mark.parametrize(
    ("kl", "factor"), [(0.0, 1.5), (0.0049, 1.5), (0.01, 1.0), (0.019, 1.0), (0.021, 1 / 1.5)]
)
def test_rate_follows_the_last_divergence(kl: float, factor: float) -> None:
    """Target .01: up below half of it, down above twice; before any was measured it is 0."""
    rate = make("kl")
    rate.last_kl = kl
    rate.adapt()
    assert rate.at(0.5) == pytest.approx(3e-4 * factor)
    assert rate.left(0.5) == 1.0


def test_rate_stays_between_its_bounds() -> None:
    """However long one side is reported."""
    rate, seen = make("kl", low=1e-5, high=3e-3), []
    for kl in (0.0, 1.0):
        rate.last_kl = kl
        for _ in range(40):
            rate.adapt()
        seen.append(rate.at(0.0))
    assert seen == [3e-3, 1e-5]


def test_rate_after_a_recovery() -> None:
    """The rule ``kl`` forgets the divergence; a constant one comes back by factors of 1.5."""
    for rule, expected in (("kl", [1.5e-4] * 3), ("constant", [2.25e-4, 3e-4, 3e-4])):
        rate, rates = make(rule), []
        rate.last_kl = 1.0
        rate.after_recovery()
        assert rate.at(0.9) == pytest.approx(1.5e-4)
        for _ in range(3):
            rate.adapt()
            rates.append(rate.at(0.9))
        assert rates == pytest.approx(expected)


def test_annealed_rate_ends_at_zero() -> None:
    """In proportion to what is left of the run."""
    rate = make("anneal")
    rate.adapt()
    assert rate.at(0.25) == pytest.approx(2.25e-4)
    assert rate.left(0.25) == 0.75
    assert rate.at(1.0) == 0.0
