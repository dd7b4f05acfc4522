"""Equation 6: move the policy's mean to what Q picks among fresh suggestions.

Source: equation 6 of the paper; with ``top = 1`` the target is the authors' best of K. It is one
step of a cross-entropy method, so it has a bound of its own on the KL divergence.
"""

import math

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.gaussian import Policy
from a2s.learner.on_policy.config import ActionMode
from a2s.learner.on_policy.step_size import gaussian_kl
from a2s.learner.on_policy.suggestion import as_q_sees, suggest

ROWS_PER_CALL = 1024


def score_in_parts(q_net: Ensemble, obs: Tensor, action: Tensor) -> Tensor:
    """Score as `Ensemble.score`, ``[N, D]``, ``[N, K, A]`` to ``[N, K]``, a cacheful at a time."""
    parts = math.ceil(action.shape[0] * action.shape[1] / ROWS_PER_CALL)
    scores = [
        q_net.score(some_obs, some_action)
        for some_obs, some_action in zip(obs.chunk(parts), action.chunk(parts), strict=True)
    ]
    return torch.cat(scores)


@torch.no_grad()
def distil_target(
    q_net: Ensemble,
    obs: Tensor,
    mean: Tensor,
    std: Tensor,
    *,
    suggestions: int,
    top: int,
    action_mode: ActionMode,
    generator: torch.Generator,
) -> Tensor:
    """Average the best ``top`` of K fresh suggestions for every observation.

    Regressing to each of the best has the same gradient as regressing to their average.

    Args:
        q_net: Already updated.
        obs: Normalised, ``[N, D]``.
        mean: Of the policy, ``[N, A]``.
        std: Of the policy, ``[A]``.
        suggestions: K.
        top: 1..K.
        action_mode: What Q sees, and what the mean moves to.
        generator: Draws the suggestions.

    Returns:
        mu^Q of equation 6, ``[N, A]``.
    """
    normal = torch.randn(len(obs), suggestions, mean.shape[1], generator=generator)
    candidates = as_q_sees(suggest(mean, std, normal), action_mode)
    best = score_in_parts(q_net, obs, candidates).topk(top, dim=1).indices
    return candidates.gather(1, best.unsqueeze(2).expand(-1, -1, mean.shape[1])).mean(1)


@torch.no_grad()
def distil_loss(mean: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of equation 6: squared error, its mean over steps and dimensions.

    Args:
        mean: Of the policy, ``[M, A]``.
        target: mu^Q, ``[M, A]``.

    Returns:
        The loss, a scalar, and its gradient by the mean, ``[M, A]``.
    """
    error = mean - target
    return error.square().mean(), error * (2.0 / error.numel())


def distil_policy(
    policy: Policy,
    optimiser: Adam,
    obs: Tensor,
    target: Tensor,
    *,
    steps: int,
    minibatch: int,
    kl_bound: float,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> tuple[float, int]:
    """Regress the mean in minibatch steps of its own, until a minibatch has moved too far.

    Args:
        policy: Changed in place.
        optimiser: Of equation 6 alone.
        obs: Normalised, ``[N, D]``.
        target: From `distil_target`, ``[N, A]``.
        steps: At most.
        minibatch: Rows of one step, drawn with replacement.
        kl_bound: Joint KL divergence, nats, from the policy before.
        learning_rate: Of Adam.
        max_grad_norm: 0: not limited.
        generator: Draws the rows.

    Returns:
        Mean loss, and steps made.
    """
    log_std = policy.log_std.clone()
    with torch.no_grad():
        before = policy(obs)
    total, made = 0.0, 0
    for _ in range(steps):
        rows = torch.randint(len(obs), (minibatch,), generator=generator)
        mean, tape = policy.trace(obs[rows])
        moved = gaussian_kl(mean, log_std, before[rows], log_std).sum(1).mean()
        if float(moved) > kl_bound:
            break
        loss, by_mean = distil_loss(mean, target[rows])
        policy.differentiate(tape, by_mean, torch.zeros_like(log_std))
        optimiser.step(policy.grad, learning_rate, max_grad_norm)
        total += loss.item()
        made += 1
    return total / max(made, 1), made
