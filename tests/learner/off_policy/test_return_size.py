"""The size of returns."""

import math

import pytest
import torch

from a2s.learner.off_policy.return_size import ReturnSize

CPU = torch.device("cpu")


def test_it_is_the_root_of_the_mean_square_of_all_samples() -> None:
    """9 and 25, then 4 and 0: (17 + 2) / 2."""
    size = ReturnSize(enabled=True, device=CPU)
    size.observe(torch.tensor([3.0, -5.0]))
    assert float(size()) == pytest.approx(math.sqrt(17.0))
    size.observe(torch.tensor([2.0, 0.0]))
    assert float(size()) == pytest.approx(math.sqrt(9.5))


def test_old_samples_fade() -> None:
    """After 50 of them the next counts as one of 50: 1 + (51 - 1) / 50."""
    size = ReturnSize(enabled=True, device=CPU)
    for _ in range(50):
        size.observe(torch.ones(2))
    size.observe(torch.full((2,), math.sqrt(51.0)))
    assert float(size()) == pytest.approx(math.sqrt(2.0))


@pytest.mark.parametrize(("reward", "size"), [(0.0, 1.0), (2.0, 2.0), (1e-9, 1e-9)])
def test_returns_that_are_all_alike_have_a_size(reward: float, size: float) -> None:
    """Something is divided by it: it is above 0 even where nothing was ever paid."""
    found = ReturnSize(enabled=True, device=CPU)
    found.observe(torch.full((8,), reward))
    assert float(found()) == pytest.approx(size)


def test_it_is_1_when_not_wanted_and_before_anything_is_known() -> None:
    """So that what is divided by it stays as it is."""
    off, new = ReturnSize(enabled=False, device=CPU), ReturnSize(enabled=True, device=CPU)
    off.observe(torch.tensor([7.0]))
    assert (float(off()), float(new())) == (1.0, 1.0)
