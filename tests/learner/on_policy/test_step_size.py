"""KL divergence and the learning rate that follows it."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from a2s.learner.on_policy.step_size import StepSize, gaussian_kl
from a2s.learner.run.config import on_policy

RATES = {"learning_rate": 3e-4, "critic_learning_rate": 3e-4}


def test_kl_agrees_with_the_textbook() -> None:
    """Against torch's distributions."""
    generator = torch.Generator().manual_seed(1)
    mean, old_mean = torch.randn(2, 5, 3, generator=generator)
    log_std, old_log_std = torch.randn(2, 3, generator=generator)
    expected = kl_divergence(Normal(mean, log_std.exp()), Normal(old_mean, old_log_std.exp()))
    torch.testing.assert_close(gaussian_kl(mean, log_std, old_mean, old_log_std), expected)


@pytest.mark.parametrize(
    ("kl", "factor"), [(0.0, 1.5), (0.0049, 1.5), (0.01, 1.0), (0.019, 1.0), (0.021, 1 / 1.5)]
)
def test_rate_follows_the_last_divergence(kl: float, factor: float) -> None:
    """Target .01: up below half of it, down above twice."""
    hyper = on_policy("modern", "a2s", {**RATES, "lr_rule": "kl", "kl_target": 0.01})
    step_size = StepSize(hyper)
    step_size.last_kl = kl
    policy, critic = step_size.adapt(0.0)
    assert policy == pytest.approx(3e-4 * factor)
    assert critic == 3e-4


def test_authors_first_update_already_runs_at_half_as_much_again() -> None:
    """The divergence is 0 before anything was measured."""
    assert StepSize(on_policy("authors", "a2s", {})).adapt(0.0) == pytest.approx((1.5e-3, 1.5e-3))


def test_rate_stays_between_its_clamps() -> None:
    """However long one side is reported."""
    step_size = StepSize(on_policy("modern", "a2s", {"lr_rule": "kl", "kl_target": 0.01}))
    for _ in range(40):
        highest, _ = step_size.adapt(0.0)
    step_size.last_kl = 1.0
    for _ in range(40):
        lowest, _ = step_size.adapt(0.0)
    assert (lowest, highest) == (1e-5, 3e-3)


def test_recovery_cuts_the_rate_and_the_target() -> None:
    """By 5 and 1.1 in the preset of the authors."""
    step_size = StepSize(on_policy("authors", "a2s", {}))
    step_size.after_recovery()
    assert step_size.rates(0.0) == pytest.approx((2e-4, 2e-4))
    assert step_size.kl_target == pytest.approx(1e-3 / 1.1)


def test_constant_rate_comes_back_after_a_recovery() -> None:
    """By factors of 1.5, and no further."""
    step_size = StepSize(on_policy("modern", "a2s", {**RATES, "lr_rule": "constant"}))
    step_size.after_recovery()
    rates = [step_size.adapt(0.0)[0] for _ in range(3)]
    assert rates == pytest.approx([2.25e-4, 3e-4, 3e-4])


def test_annealed_rate_ends_at_zero() -> None:
    """In proportion to what is left of the run."""
    step_size = StepSize(on_policy("modern", "a2s", {**RATES, "lr_rule": "anneal"}))
    assert step_size.adapt(0.25) == pytest.approx((2.25e-4, 2.25e-4))
    assert step_size.adapt(1.0) == (0.0, 0.0)
