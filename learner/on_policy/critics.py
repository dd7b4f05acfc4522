"""Fitting Q and V to the targets of a batch, by either rule."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.fit import Regression, fit_epochs, fit_threshold, num_chunks
from a2s.learner.on_policy.state import Learned
from a2s.learner.on_policy.targets import q_input


class Fits(NamedTuple):
    """Losses in normalised returns, and gradient steps, of Q and V; 0 where not fitted."""

    q_loss: float = 0.0
    value_loss: float = 0.0
    q_steps: int = 0
    value_steps: int = 0


def fit_critics(
    batch: Batch,
    seen: Tensor,
    target: Tensor,
    learned: Learned,
    hyper: OnPolicyConfig,
    *,
    learning_rate: float,
    order: torch.Generator,
    q_order: torch.Generator,
) -> Fits:
    """Fit V, and Q where something reads it.

    V learns the same to the bit whether or not Q is fitted beside it.

    Args:
        batch: Gives the executed actions.
        seen: Normalised observations, ``[N, D]``.
        target: In returns, ``[N]``; their scale is updated first.
        learned: Changed in place.
        hyper: Rule, passes or steps, minibatch.
        learning_rate: Of both.
        order: Draws minibatches, for both in the rule ``epochs``.
        q_order: Draws those of Q in the rule ``threshold``.
    """
    learned.returns.update(target)
    wanted = learned.returns.normalise(target)
    value = Regression(network=learned.value_net, inputs=seen, optimiser=learned.adam["value"])
    jobs = [value]
    if hyper.uses_q:
        inputs = q_input(batch, seen, hyper)
        jobs.append(Regression(network=learned.q_net, inputs=inputs, optimiser=learned.adam["q"]))
    if hyper.fit_rule == "epochs":
        return _by_epochs(jobs, wanted, hyper, learning_rate, order)
    value_loss, value_steps = _by_threshold(
        value, wanted, learned, hyper, hyper.value_fit_extra_steps, learning_rate, order
    )
    q_loss, q_steps = 0.0, 0
    if hyper.uses_q:
        q_loss, q_steps = _by_threshold(
            jobs[1], wanted, learned, hyper, hyper.q_fit_extra_steps, learning_rate, q_order
        )
    return Fits(q_loss, value_loss, q_steps, value_steps)


def _by_epochs(
    jobs: list[Regression],
    target: Tensor,
    hyper: OnPolicyConfig,
    learning_rate: float,
    generator: torch.Generator,
) -> Fits:
    losses = fit_epochs(
        jobs,
        target,
        epochs=hyper.critic_epochs,
        minibatch=hyper.critic_minibatch,
        min_minibatches=hyper.min_minibatches,
        learning_rate=learning_rate,
        max_grad_norm=hyper.max_grad_norm,
        generator=generator,
    )
    chunks = num_chunks(len(target), hyper.critic_minibatch, hyper.min_minibatches)
    steps = hyper.critic_epochs * chunks
    if len(jobs) == 1:
        return Fits(value_loss=losses[0], value_steps=steps)
    return Fits(losses[1], losses[0], steps, steps)


def _by_threshold(
    job: Regression,
    target: Tensor,
    learned: Learned,
    hyper: OnPolicyConfig,
    extra_steps: int,
    learning_rate: float,
    generator: torch.Generator,
) -> tuple[float, int]:
    return fit_threshold(
        job,
        target,
        steps=hyper.fit_steps,
        extra_steps=extra_steps,
        threshold=hyper.fit_threshold / learned.returns.std**2,
        minibatch=hyper.critic_minibatch,
        learning_rate=learning_rate,
        max_grad_norm=hyper.max_grad_norm,
        generator=generator,
    )
