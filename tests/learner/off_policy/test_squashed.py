"""The tanh-Gaussian policy."""

import math

import pytest
import torch

from a2s.learner.off_policy.squashed import gaussian, log_density


def test_log_density_by_hand() -> None:
    """At u = .5 with mean 0 and std 1: -ln sqrt(2 pi) - .125 - ln(1 - tanh(.5)^2)."""
    u = torch.tensor([[0.5]])
    expected = -0.918939 - 0.125 - math.log(1.0 - math.tanh(0.5) ** 2)
    assert float(log_density(u, u, torch.zeros(1, 1))) == pytest.approx(expected, abs=1e-5)


def test_density_integrates_to_one() -> None:
    """Over the actions, -1 to 1."""
    action = torch.linspace(-0.99999, 0.99999, 200_001, dtype=torch.float64).unsqueeze(1)
    log_std = torch.full_like(action, -0.3)
    u = action.atanh()
    density = log_density(u, (u - 0.4) / log_std.exp(), log_std).exp()
    assert float(torch.trapezoid(density, action.squeeze(1))) == pytest.approx(1.0, abs=1e-3)


def test_log_density_is_finite_at_the_bounds() -> None:
    """tanh(30) is 1 in float32; ln(1 - 1) is not a number to learn from."""
    u = torch.tensor([[30.0], [-30.0]])
    found = log_density(u, torch.zeros(2, 1), torch.zeros(2, 1))
    assert found.tolist() == pytest.approx([-0.918939 + 60 - 2 * math.log(2)] * 2, abs=1e-4)


def test_log_std_is_held_within_its_range() -> None:
    """And has no gradient at the ends."""
    found = gaussian(torch.tensor([[1.0, 2.0, 3.0, 9.0, -0.5, -99.0]]))
    assert found.mean.tolist() == [[1.0, 2.0, 3.0]]
    assert found.log_std.tolist() == [[2.0, -0.5, -10.0]]
    assert found.free.tolist() == [[0.0, 1.0, 0.0]]
