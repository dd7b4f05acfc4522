"""Losses of the critics, and their gradients."""

import pytest
import torch
from torch import Tensor

from a2s.learner.off_policy.losses import quantile_loss, squared_loss


def test_squared_loss_by_hand() -> None:
    """Errors 2 and -1, and 0 and 3, the rows weighing 1 and .5; half their squares, / 2 rows."""
    q_value = torch.tensor([[[3.0], [1.0]], [[1.0], [5.0]]])
    found = squared_loss(q_value, torch.tensor([[1.0], [2.0]]), torch.tensor([1.0, 0.5]))
    assert float(found.loss) == pytest.approx(0.5 * (4.0 + 0.5 + 0.0 + 4.5) / 2)
    assert found.grad.flatten().tolist() == [1.0, -0.25, 0.0, 0.75]
    assert found.error.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("atoms", "target", "width", "expected"),
    [
        ([0.0], [0.5], 1.0, 0.0625),  # median: .5 * .5 * .25
        ([0.0], [-0.5], 1.0, 0.0625),
        ([0.0], [3.0], 1.0, 1.25),  # beyond 1: .5 * (3 - .5)
        ([0.0, 0.0], [1.0], 1.0, 0.25),  # levels .25, .75: mean(.25, .75) * .5
        ([1.0, 0.0], [0.0], 1.0, 0.1875),  # the first is too high: (1 - .25) * .5, / 2
        ([0.0], [0.5, -0.5, 3.0], 1.0, 0.458333),  # mean over the targets
        ([0.0], [0.5], 0.2, 0.2),  # beyond .2: .5 * (.5 - .1)
        ([0.0], [0.5], 2.0, 0.03125),  # within 2: .5 * .5 * .25 / 2
    ],
)
def test_quantile_loss_by_hand(
    atoms: list[float], target: list[float], width: float, expected: float
) -> None:
    """One critic, one row."""
    found = quantile_loss(torch.tensor([[atoms]]), torch.tensor([target]), torch.ones(1), width)
    assert float(found.loss) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("precise", [torch.float32, torch.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("atoms", [1, 4])
def test_gradients_are_those_of_autograd(atoms: int, precise: torch.dtype) -> None:
    """Of the loss itself, weights included; quantiles in f32 by the kernel, in f64 by torch."""
    generator = torch.Generator().manual_seed(0)
    q_value = torch.randn(3, 6, atoms, generator=generator, dtype=precise, requires_grad=True)
    target = 2.0 * torch.randn(6, atoms if atoms == 1 else 7, generator=generator, dtype=precise)
    weight = torch.rand(6, generator=generator, dtype=precise)
    if atoms == 1:
        loss = (0.5 * weight * (q_value - target).square().squeeze(2)).mean(1).sum()
        found = squared_loss(q_value.detach(), target, weight)
    else:
        loss = slow_quantile_loss(q_value, target, weight, width=0.7)
        found = quantile_loss(q_value.detach(), target, weight, 0.7)
    torch.autograd.backward(loss)
    assert q_value.grad is not None
    torch.testing.assert_close(found.loss, loss.detach())
    torch.testing.assert_close(found.grad, q_value.grad)


def slow_quantile_loss(q_value: Tensor, target: Tensor, weight: Tensor, width: float) -> Tensor:
    """Dabney et al. 2018, equation 10, one pair at a time."""
    members, rows, atoms = q_value.shape
    total = torch.zeros(())
    for member in range(members):
        for row in range(rows):
            for i in range(atoms):
                for wanted in target[row]:
                    u = wanted - q_value[member, row, i]
                    near = float(u.abs().detach()) <= width
                    huber = 0.5 * u**2 / width if near else u.abs() - 0.5 * width
                    level = (i + 0.5) / atoms
                    blame = abs(level - float(u.detach() < 0))
                    share = weight[row] / (rows * atoms * target.shape[1])
                    total = total + share * blame * huber
    return total


def test_quantiles_settle_at_the_quantiles() -> None:
    """Atoms of a fit to a uniform target are at 1/8, 3/8, 5/8, 7/8 of its range."""
    generator = torch.Generator().manual_seed(0)
    atoms = torch.zeros(1, 1, 4)
    for _ in range(3000):
        target = 0.8 * torch.rand(1, 64, generator=generator)
        atoms -= 0.5 * quantile_loss(atoms, target, torch.ones(1), 1.0).grad
    found = atoms.flatten() / 0.8
    assert bool((found.diff() > 0.1).all())
    assert float(found.mean()) == pytest.approx(0.5, abs=0.03)
