"""What Q's opinion is worth."""

import math

import pytest
import torch

from a2s.learner.on_policy.calibration import FULL_BATCH, Calibration


def seen_by(slope: float, batches: int = 60, scale: float = 1.0) -> Calibration:
    """Q says something, of which ``slope`` is true beside noise of deviation 2."""
    generator = torch.Generator().manual_seed(0)
    found = Calibration()
    for _ in range(batches):
        said, noise = torch.randn(2, FULL_BATCH, generator=generator)
        found.update(scale * said, slope * said + 2.0 * noise, torch.ones(FULL_BATCH))
    return found


@pytest.mark.parametrize("slope", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("scale", [0.01, 1.0])
def test_slope_is_what_is_true_of_it(slope: float, scale: float) -> None:
    """Whatever its unit, unless that makes the slope larger than 1: it is not blown up."""
    found = seen_by(slope, scale=scale)
    assert found.slope == pytest.approx(min(slope / scale, 1.0), abs=0.03)
    deviation = math.sqrt(slope**2 + 4.0)
    assert found.correlation == pytest.approx(slope / deviation, abs=0.03)
    assert found.factor == pytest.approx(found.slope / deviation, rel=0.03)


def test_what_is_wrong_counts_for_nothing() -> None:
    """So do silence, and no batch at all."""
    assert seen_by(-0.5).slope == seen_by(-0.5).factor == 0.0
    silent = Calibration()
    silent.update(torch.zeros(9), torch.randn(9), torch.ones(9))
    assert silent.slope == silent.factor == Calibration().factor == Calibration().slope == 0.0


def test_it_forgets() -> None:
    """After ten full batches of noise little is left of what was true."""
    found = seen_by(1.0)
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        said, noise = torch.randn(2, FULL_BATCH, generator=generator)
        found.update(said, noise, torch.ones(FULL_BATCH))
    assert found.slope < 0.2


def test_small_batches_count_as_little_as_they_hold() -> None:
    """Eight of an eighth are one."""
    said = torch.randn(FULL_BATCH, generator=torch.Generator().manual_seed(0))
    whole, parts = Calibration(), Calibration()
    whole.update(said, 2 * said, torch.ones(FULL_BATCH))
    for part in said.chunk(8):
        parts.update(part, 2 * part, torch.ones(len(part)))
    assert parts.said == pytest.approx(whole.said, rel=0.05)


def test_weights_make_it_a_regression_over_the_policy() -> None:
    """A weight of 2 counts a step twice."""
    said, seen = torch.tensor([1.0, -1.0, 0.0]), torch.tensor([2.0, -2.0, 0.0])
    twice, written_out = Calibration(), Calibration(memory=0.9 ** (3 / 4))  # of as many steps
    twice.update(said, seen, torch.tensor([1.5, 0.75, 0.75]))
    four = torch.tensor([0, 0, 1, 2])
    written_out.update(said[four], seen[four], torch.ones(4))
    assert twice.slope == pytest.approx(written_out.slope)
    assert twice.said == pytest.approx(written_out.said)
