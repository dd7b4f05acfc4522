"""Equation 6: move the policy's mean to what Q picks among fresh suggestions.

It is one step of a cross-entropy method, so it has a bound of its own on the KL divergence.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.gaussian import Policy
from a2s.learner.on_policy.acting import ActionMode, as_q_sees, suggest, take
from a2s.learner.on_policy.policy import gaussian_kl


class Distilled(NamedTuple):
    """Mean loss of equation 6, and its gradient steps."""

    distil_loss: float = 0.0
    distil_steps: int = 0


@torch.no_grad()
def distil_target(
    q_net: Ensemble,
    policy: Policy,
    norm_obs: Tensor,
    *,
    suggestions: int,
    action_mode: ActionMode,
    generator: torch.Generator,
) -> Tensor:
    """Pick the best of K fresh suggestions for every observation, as Q sees it.

    Q is already updated; observations are ``[N, D]``.

    Returns:
        mu^Q of equation 6, ``[N, A]``.
    """
    mean = policy(norm_obs)
    normal = torch.randn(len(mean), suggestions, mean.shape[1], generator=generator)
    candidates = as_q_sees(suggest(mean, policy.std(), normal), action_mode)
    return take(candidates, q_net.score(norm_obs, candidates).argmax(1))


@torch.no_grad()
def distil_loss(mean: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Squared error, its mean over steps and dimensions, and its gradient by the mean ``[M, A]``.

    Source: equation 6 of the paper, as printed.
    """
    error = mean - target
    return error.square().mean(), error * (2.0 / error.numel())


def distil_policy(
    policy: Policy,
    optimiser: Adam,
    norm_obs: Tensor,
    target: Tensor,
    *,
    steps: int,
    minibatch: int,
    kl_bound: float,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> Distilled:
    """Regress the mean in minibatch steps of its own, until a minibatch has moved too far.

    The target is that of `distil_target`; rows are drawn with replacement. The bound is on the
    joint KL divergence from the policy before, nats. The optimiser is of equation 6 alone;
    ``max_grad_norm`` 0: not limited.
    """
    log_std = policy.log_std.clone()
    with torch.no_grad():
        before = policy(norm_obs)
    total, made = 0.0, 0
    for _ in range(steps):
        rows = torch.randint(len(norm_obs), (minibatch,), generator=generator)
        mean, tape = policy.trace(norm_obs[rows])
        moved = gaussian_kl(mean, log_std, before[rows], log_std).sum(1).mean()
        if float(moved) > kl_bound:
            break
        loss, grad_mean = distil_loss(mean, target[rows])
        policy.differentiate(tape, grad_mean, torch.zeros_like(log_std))
        optimiser.step(policy.grad, learning_rate, max_grad_norm)
        total += loss.item()
        made += 1
    return Distilled(total / max(made, 1), made)
