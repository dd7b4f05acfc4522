"""Fitting V and Q."""

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.critics import (
    Fit,
    Regression,
    make,
    make_beside,
    num_minibatches,
    q_fit,
    value_fit,
)
from a2s.learner.on_policy.state import make_q


def job_of(seed: int = 0) -> tuple[Regression, Tensor]:
    """Build a linear network and a target that it can learn."""
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(96, 3, generator=generator)
    target = inputs @ torch.tensor([1.0, -2.0, 0.5]) + 0.7
    form = Form((3, 1), activation="tanh", layer_norm=True)
    network = Ensemble(form, form.draw(1, generator, init="orthogonal"), single=True)
    return Regression(network, Adam(network.value), inputs), target


def predict(job: Regression) -> Tensor:
    """What a fitted network says of its inputs, ``[N]``."""
    return job.network(job.inputs).squeeze(-1)


def fit(value: Regression, target: Tensor, epochs: int = 1, rate: float = 0.05) -> Fit:
    """Prepare a fit with a fixed order of rows."""
    return value_fit(
        value,
        target,
        epochs=epochs,
        minibatch=32,
        min_minibatches=1,
        learning_rate=rate,
        max_grad_norm=0.0,
        generator=torch.Generator().manual_seed(5),
    )


def test_passes_learn_a_linear_target() -> None:
    """A hundred passes are plenty."""
    job, target = job_of()
    make(fit(job, target, 100))
    assert float((predict(job) - target).square().mean()) < 1e-3
    assert int(job.optimiser.steps) == 300


def test_loss_is_the_mean_squared_error() -> None:
    """At rate 0 the mean of passes over equal parts is that of the batch."""
    job, target = job_of()
    expected = float((predict(job) - target).square().mean())
    loss = make(fit(job, target, 2, rate=0.0))
    assert loss == pytest.approx(expected, rel=1e-5)


def test_q_learns_what_it_is_told() -> None:
    """Both critics, of every input; the loss falls to that of a target's width."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.rand(512, 3, generator=generator) * 2 - 1
    target = 4.0 * inputs[:, 0] - 3.0 * inputs[:, 1] * inputs[:, 2]
    q_net = make_q(3, (32, 32), generator)
    adam = Adam(q_net.value)
    losses = []
    for steps in (1, 600, 1):
        some = q_fit(
            q_net,
            adam,
            inputs,
            target,
            steps=steps,
            minibatch=64,
            learning_rate=3e-3,
            generator=generator,
        )
        losses.append(make(some))
    values = torch.linspace(-categorical.HALF_RANGE, categorical.HALF_RANGE, categorical.BINS)
    wrong = q_net(inputs).softmax(-1) @ values - target
    assert wrong.shape == (2, 512)
    assert float(wrong.abs().mean()) < 0.2
    assert losses[0] == pytest.approx(math.log(categorical.BINS), abs=0.3)
    assert losses[2] < 1.6


@pytest.mark.parametrize(
    ("rows", "minibatch", "at_least", "expected"),
    [(2048, 256, 1, 8), (2100, 256, 8, 8), (100, 256, 1, 1), (100, 256, 8, 8), (5, 4, 8, 5),
     (99, 0, 8, 1)],
)  # fmt: skip
def test_minibatches_are_nearly_equal(
    rows: int, minibatch: int, at_least: int, expected: int
) -> None:
    """A short last minibatch would count as much as a whole one."""
    assert num_minibatches(rows, minibatch, at_least) == expected


def test_steps_are_those_of_the_layers() -> None:
    """Two passes over V beside three steps of Q: losses and parameters, by layers and Adam."""
    generator = torch.Generator().manual_seed(0)
    inputs, target = torch.randn(50, 4, generator=generator), torch.randn(50, generator=generator)
    form = Form((4, 16, 8, 1), activation="tanh", layer_norm=True)
    flat = form.draw(1, generator, init="orthogonal")
    nets = [Ensemble(form, flat.clone(), single=True) for _ in range(2)]
    jobs = [Regression(net, Adam(net.value), inputs) for net in nets]
    both = [make_q(4, (16, 8), torch.Generator().manual_seed(1)) for _ in range(2)]
    adams = [Adam(each.value) for each in both]
    q = q_fit(
        both[0], adams[0], inputs, target, steps=3, minibatch=20, learning_rate=1e-2,
        generator=torch.Generator().manual_seed(2),
    )  # fmt: skip
    q_loss, value_loss = make_beside(partial(make, q), fit(jobs[0], target, 2, 1e-2))

    order, losses = torch.Generator().manual_seed(5), []
    for _ in range(2):
        rows = torch.randperm(50, generator=order)
        for some in (rows[:25], rows[25:]):
            losses.append(float(jobs[1].step(inputs[some], target[some], 1e-2)))
    assert value_loss == pytest.approx(sum(losses) / 4, rel=1e-4)
    torch.testing.assert_close(nets[0].value, nets[1].value, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(jobs[0].optimiser.steps, jobs[1].optimiser.steps)

    chance, order = categorical.spread(target), torch.Generator().manual_seed(2)
    total = 0.0
    for rows in torch.randint(50, (60,), generator=order).view(3, 20):
        logits, tape = both[1].trace(inputs[rows])
        log_chance = logits.log_softmax(-1)
        total -= float((chance[rows] * log_chance).sum()) / 20 / 2
        both[1].differentiate(tape, (log_chance.exp() - chance[rows]) / 20)
        adams[1].step(both[1].grad, 1e-2)
    assert q_loss == pytest.approx(total / 3, rel=1e-4)
    torch.testing.assert_close(both[0].value, both[1].value, rtol=0.0, atol=1e-4)
