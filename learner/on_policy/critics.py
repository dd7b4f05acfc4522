"""Fitting Q and V to the targets of a batch.

Source: section 4.1.1 of the paper, "we take multiple gradient steps for value network and Q
network".
"""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble


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


def fit_critics(
    value: Regression,
    q: Regression | None,
    target: Tensor,
    *,
    epochs: int,
    minibatch: int,
    min_minibatches: int,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> Fits:
    """Fit V, and Q where something reads it, in passes over the same minibatches.

    V learns the same to the bit whether or not Q is fitted beside it. The target of both is
    normalised, ``[N]``; ``max_grad_norm`` is of each, 0: not limited; losses are of the last pass.
    """
    jobs = [value] if q is None else [value, q]
    count = num_minibatches(len(target), minibatch, min_minibatches)
    totals = torch.zeros(len(jobs))
    for _ in range(epochs):
        order = torch.randperm(len(target), generator=generator)
        targets = target[order].tensor_split(count)
        inputs = [job.inputs[order].tensor_split(count) for job in jobs]
        totals.zero_()
        for index, wanted in enumerate(targets):
            for number, job in enumerate(jobs):
                totals[number] += job.step(
                    inputs[number][index], wanted, learning_rate, max_grad_norm
                )
    value_loss, *q_loss = (totals / count).tolist()
    steps = epochs * count
    if q is None:
        return Fits(value_loss=value_loss, value_fit_steps=steps)
    return Fits(q_loss[0], value_loss, steps, steps)
