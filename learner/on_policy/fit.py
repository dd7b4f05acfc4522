"""Regression of Q and V on targets: several gradient steps for every batch.

Source: section 4.1.1 of the paper, "we take multiple gradient steps for value network and Q
network".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """One network to be fitted.

    Attributes:
        network: A single one with one output.
        inputs: What it sees, ``[N, in]``.
        optimiser: Of its parameters.
    """

    network: Ensemble
    inputs: Tensor
    optimiser: Adam

    @torch.no_grad()
    def step(
        self, inputs: Tensor, target: Tensor, learning_rate: float, max_grad_norm: float
    ) -> Tensor:
        """Make a step down the mean squared error, and return it."""
        value, tape = self.network.trace(inputs)
        error = value.squeeze(-1) - target
        self.network.differentiate(tape, (error * (2.0 / len(target))).unsqueeze(-1))
        self.optimiser.step(self.network.grad, learning_rate, max_grad_norm)
        return error.square().sum() / len(target)


def num_chunks(rows: int, minibatch: int, least: int) -> int:
    """Minibatches in one pass: nearly equal ones of about the wanted size, 0 for the whole.

    A small batch is cut into ``least``: else a run that begins with small batches makes few steps.
    """
    return max(min(least, rows), round(rows / minibatch)) if minibatch else 1


def fit_epochs(
    jobs: Sequence[Regression],
    target: Tensor,
    *,
    epochs: int,
    minibatch: int,
    min_minibatches: int,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> list[float]:
    """Fit networks side by side, all on the same minibatches, in passes over the batch.

    Args:
        jobs: Networks and their inputs.
        target: What all of them regress to, ``[N]``.
        epochs: Passes.
        minibatch: Rows of one step, about.
        min_minibatches: In one pass.
        learning_rate: Of all of them.
        max_grad_norm: Of each of them; 0: not limited.
        generator: Draws the order.

    Returns:
        Mean loss of each network in the last pass.
    """
    count = num_chunks(len(target), minibatch, min_minibatches)
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
    return (totals / count).tolist()


def fit_threshold(
    job: Regression,
    target: Tensor,
    *,
    steps: int,
    extra_steps: int,
    threshold: float,
    minibatch: int,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> tuple[float, int]:
    """Fit one network for some steps, then on until the running mean of its losses is low.

    Args:
        job: The network and its inputs.
        target: What it regresses to, ``[N]``.
        steps: Always made.
        extra_steps: At most so many more.
        threshold: Mean of all losses of this call below which it stops.
        minibatch: Rows of one step, drawn with replacement.
        learning_rate: Of Adam.
        max_grad_norm: 0: not limited.
        generator: Draws the rows.

    Returns:
        Mean loss, and steps made.

    Source: the authors' code (100 steps, up to 5000 more for Q and 100 for V, threshold 100).
    """
    total = 0.0
    for made in range(1, steps + extra_steps + 1):
        rows = torch.randint(len(target), (minibatch,), generator=generator)
        loss = job.step(job.inputs[rows], target[rows], learning_rate, max_grad_norm)
        total += loss.item()
        if made > steps and total / made < threshold:
            break
    return total / made, made
