"""Fitting Q and V."""

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.on_policy.fit import Regression, fit_epochs, fit_threshold, num_chunks


def linear(inputs: Tensor, seed: int = 0) -> Regression:
    """Build linear networks of three inputs."""
    generator = torch.Generator().manual_seed(seed)
    form = Form((3, 1), activation="tanh", layer_norm=True)
    network = Ensemble(form, form.draw(1, generator, init="orthogonal"), single=True)
    return Regression(network=network, inputs=inputs, optimiser=Adam(network.value))


def job_of(seed: int = 0, rows: int = 96) -> tuple[Regression, Tensor]:
    """Build a linear network and a target that it can learn."""
    inputs = torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))
    target = inputs @ torch.tensor([1.0, -2.0, 0.5]) + 0.7
    return linear(inputs, seed), target


def predict(job: Regression) -> Tensor:
    """What a fitted network says of its inputs, ``[N]``."""
    return job.network(job.inputs).squeeze(-1)


def epochs(
    jobs: list[Regression], target: Tensor, count: int = 1, rate: float = 0.05
) -> list[float]:
    """Fit with a fixed order of rows."""
    return fit_epochs(
        jobs,
        target,
        epochs=count,
        minibatch=32,
        min_minibatches=1,
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
    expected = float((predict(job) - target).square().mean())
    assert epochs([job], target, rate=0.0) == [pytest.approx(expected, rel=1e-5)]


def test_company_changes_nothing() -> None:
    """Fitted beside another, a network learns the same to the bit."""
    alone, target = job_of()
    together, _ = job_of()
    other, _ = job_of(seed=9)
    assert epochs([alone], target)[0] == epochs([together, other], target)[0]
    assert torch.equal(predict(alone), predict(together))


@pytest.mark.parametrize(
    ("rows", "minibatch", "least", "chunks"),
    [(2048, 256, 1, 8), (2100, 256, 8, 8), (100, 256, 1, 1), (100, 256, 8, 8), (5, 4, 8, 5),
     (99, 0, 8, 1)],
)  # fmt: skip
def test_minibatches_are_nearly_equal(rows: int, minibatch: int, least: int, chunks: int) -> None:
    """A short last minibatch would count as much as a whole one."""
    assert num_chunks(rows, minibatch, least) == chunks


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
