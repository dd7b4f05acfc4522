"""Fitting Q and V."""

import pytest
import torch
from torch import Tensor, nn

from a2s.learner.algorithm.fit import Regression, fit_epochs, fit_threshold, num_chunks
from a2s.learner.algorithm.optimiser import Adam, FlatParameters


def job_of(seed: int = 0, rows: int = 96) -> tuple[Regression, Tensor]:
    """Build a linear network and a target that it can learn."""
    torch.manual_seed(seed)
    net = nn.Linear(3, 1)
    inputs = torch.randn(rows, 3)
    target = inputs @ torch.tensor([1.0, -2.0, 0.5]) + 0.7
    adam = Adam(FlatParameters(net))
    return Regression(predict=lambda x: net(x)[:, 0], inputs=inputs, optimiser=adam), target


def epochs(
    jobs: list[Regression], target: Tensor, count: int = 1, rate: float = 0.05
) -> list[float]:
    """Fit with a fixed order of rows."""
    return fit_epochs(
        jobs,
        target,
        epochs=count,
        minibatch=32,
        learning_rate=rate,
        max_grad_norm=0.0,
        generator=torch.Generator().manual_seed(5),
    )


def test_passes_learn_a_linear_target() -> None:
    """A hundred passes are plenty."""
    job, target = job_of()
    (loss,) = epochs([job], target, 100)
    assert loss < 1e-3


def test_loss_is_the_mean_squared_error_of_the_last_pass() -> None:
    """At rate 0 the loss of a pass is that of the batch."""
    job, target = job_of()
    expected = float((job.predict(job.inputs) - target).square().mean().detach())
    assert epochs([job], target, rate=0.0) == [pytest.approx(expected, rel=1e-5)]


def test_ensemble_members_learn_as_if_alone() -> None:
    """The loss is summed over an ensemble, so that members do not share one gradient's size."""
    target = torch.tensor([1.0, 3.0])
    job = Regression(
        predict=lambda _: torch.tensor([[0.0, 0.0], [1.0, 1.0]]),
        inputs=torch.zeros(2, 1),
        optimiser=Adam(FlatParameters(nn.Linear(1, 1))),
    )
    assert float(job.loss(job.inputs, target)) == 5.0 + 2.0


def test_company_changes_nothing() -> None:
    """Fitted beside another, a network learns the same to the bit."""
    alone, target = job_of()
    together, _ = job_of()
    other, _ = job_of(seed=9)
    assert epochs([alone], target)[0] == epochs([together, other], target)[0]
    assert torch.equal(alone.predict(alone.inputs), together.predict(alone.inputs))


@pytest.mark.parametrize(
    ("rows", "minibatch", "chunks"), [(2048, 256, 8), (2100, 256, 8), (100, 256, 1), (99, 0, 1)]
)
def test_minibatches_are_nearly_equal(rows: int, minibatch: int, chunks: int) -> None:
    """A short last minibatch would count as much as a whole one."""
    assert num_chunks(rows, minibatch) == chunks


@pytest.mark.parametrize(
    ("threshold", "steps"),
    [(1e9, 11), (0.0, 30)],  # one step more where the loss is low, all of them where it never is
)
def test_threshold_rule_stops_when_the_mean_loss_is_low(threshold: float, steps: int) -> None:
    """The authors' rule, in small."""
    job, target = job_of()
    _, made = fit_threshold(
        job,
        target,
        steps=10,
        extra_steps=20,
        threshold=threshold,
        minibatch=16,
        learning_rate=1e-3,
        max_grad_norm=0.0,
        generator=torch.Generator().manual_seed(0),
    )
    assert made == steps
