"""Fitting V to the targets of a batch, and Q to those of the window.

Source: section 4.1.1 of the paper, "we take multiple gradient steps for value network and Q
network".
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.compiled import run_together, vectors
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy import categorical, fit_kernels
from a2s.protocol.fields import Array

_Work = TypeVar("_Work")


class Fits(NamedTuple):
    """Losses in normalised returns, and gradient steps; 0 where not fitted."""

    q_loss: float = 0.0
    value_loss: float = 0.0
    q_fit_steps: int = 0
    value_fit_steps: int = 0


class Regression(NamedTuple):
    """A network with one output to be fitted, and its inputs, ``[N, in]``."""

    network: Ensemble
    optimiser: Adam
    inputs: Tensor

    @torch.no_grad()
    def step(
        self, inputs: Tensor, target: Tensor, learning_rate: float, max_grad_norm: float = 0.0
    ) -> Tensor:
        """Make a step down the mean squared error, and return it."""
        value, tape = self.network.trace(inputs)
        error = value.squeeze(-1) - target
        self.network.differentiate(tape, (error * (2.0 / len(target))).unsqueeze(-1))
        self.optimiser.step(self.network.grad, learning_rate, max_grad_norm)
        return error.square().sum() / len(target)


def num_minibatches(rows: int, minibatch: int, at_least: int) -> int:
    """Minibatches in one pass: nearly equal ones of about the wanted size, 0 for the whole.

    A small batch is cut into ``at_least``: else a run that begins with small batches makes few
    steps.
    """
    return max(min(at_least, rows), round(rows / minibatch)) if minibatch else 1


class Fit(NamedTuple):
    """A fit that is ready to be made.

    Attributes:
        calls: One for each network; it makes the steps, and returns the sum of their losses.
        optimiser: Of the networks.
        steps: Of each network.
    """

    calls: Sequence[Callable[[], float]]
    optimiser: Adam
    steps: int


def make(fit: Fit) -> float:
    """Make a fit, its networks side by side; returns the mean loss of a step."""
    return _finish(fit, run_together(fit.calls))


def make_beside(work: Callable[[], _Work], fit: Fit) -> tuple[_Work, float]:
    """Make a fit while this thread does other work; returns what that gives, and the loss."""
    done, *losses = run_together([work, *fit.calls])
    return done, _finish(fit, losses)


def _finish(fit: Fit, losses: Sequence[float]) -> float:
    fit.optimiser.steps += fit.steps
    return sum(losses) / fit.steps / len(fit.calls)


def value_fit(
    value: Regression,
    target: Tensor,
    *,
    epochs: int,
    minibatch: int,
    min_minibatches: int,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> Fit:
    """Fit V in passes over shuffled minibatches.

    The target is normalised, ``[N]``; ``max_grad_norm`` 0: not limited.
    """
    rows, optimiser = len(target), value.optimiser
    count = num_minibatches(rows, minibatch, min_minibatches)
    order = torch.cat([torch.randperm(rows, generator=generator) for _ in range(epochs)])
    begins = np.arange(epochs)[:, None] * rows + bounds(rows, count)[:-1]
    call = partial(
        fit_kernels.value_pass, vectors(optimiser, value.network, value.network.grad),
        value.inputs.numpy(), target.numpy(), order.numpy(), np.append(begins, len(order)),
        int(optimiser.steps), learning_rate, max_grad_norm,
    )  # fmt: skip
    return Fit([call], optimiser, epochs * count)


def bounds(rows: int, count: int) -> Array:
    """Ends of so many nearly equal parts of so many rows, and a 0 before them, int64."""
    return np.linspace(0, rows, count + 1).round().astype(np.int64)


def q_fit(
    q_net: Ensemble,
    optimiser: Adam,
    inputs: Tensor,
    target: Tensor,
    *,
    steps: int,
    minibatch: int,
    learning_rate: float,
    generator: torch.Generator,
) -> Fit:
    """Fit categorical Q to targets in its own unit, ``[N, in]`` and ``[N]``, rows drawn anew.

    The loss is the cross-entropy, nats.
    """
    drawn = torch.randint(len(target), (steps * minibatch,), generator=generator)
    chance, order = categorical.spread(target[drawn]).numpy(), drawn.numpy()
    ends, before = bounds(len(order), steps), int(optimiser.steps)
    calls = [
        partial(
            fit_kernels.q_pass, vectors(optimiser, q_net, q_net.grad, member=member),
            inputs.numpy(), chance, order, ends, before, learning_rate,
        )
        for member in range(q_net.members)
    ]  # fmt: skip
    return Fit(calls, optimiser, steps)
