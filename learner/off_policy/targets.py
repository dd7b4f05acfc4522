"""Equations 7 and 8: what the best of K suggestions is worth in the next state.

One critic selects, others evaluate: the maximum over K of a noisy estimate, taken at its own
word, exceeds the truth by 1.5 standard deviations of the noise at K = 10.

Source: equations 7, 8 and algorithm 2 of the paper; entropy as in SAC (Haarnoja et al. 2018).
"""

import math

import torch
from torch import Tensor


def log_advantage(suggestions: int) -> float:
    """Expected log ratio of the density of the best of K to the policy's, nats; 0 for K = 1.

    ``c_K = log K - (K - 1) / K``, whatever the scores, as long as no two are equal.
    """
    return math.log(suggestions) - (suggestions - 1) / suggestions


def pick_best(score: Tensor, *candidates: Tensor) -> list[Tensor]:
    """Take of each candidate what belongs to the largest score.

    Args:
        score: ``[..., K]``; among equals the first counts.
        candidates: Each ``[..., K, A]``.

    Returns:
        As many, each ``[..., A]``.
    """
    best = score.argmax(-1)[..., None, None]
    return [
        candidate.gather(-2, best.expand(*best.shape[:-1], candidate.shape[-1])).squeeze(-2)
        for candidate in candidates
    ]


def evaluate(q_value: Tensor, dropped: int) -> Tensor:
    """One value, or one set of atoms, from those of all target critics.

    Args:
        q_value: ``[E, ..., M]``, M = 1 for plain critics.
        dropped: Quantile critics: atoms per critic that are left out, the largest of all.

    Returns:
        Plain: the minimum over the critics, ``[..., 1]``. Quantiles: those that are left of all
        ``E M`` atoms, ascending, ``[..., E (M - dropped)]``.

    Source: Fujimoto et al. 2018 for the minimum; Kuznetsov et al. 2020 (TQC), equation 11.
    """
    if q_value.shape[-1] == 1:
        return q_value.amin(0)
    pooled = q_value.movedim(0, -2).flatten(-2)
    return pooled.sort(dim=-1).values[..., : pooled.shape[-1] - dropped * len(q_value)]


def backup(
    reward: Tensor,
    discount: Tensor,
    value: Tensor,
    log_prob: Tensor,
    *,
    temperature: Tensor,
    suggestions: int,
) -> Tensor:
    """Targets of the critics.

    Args:
        reward: ``[B]``.
        discount: 0 after a terminal state, ``[B]``.
        value: Of the best suggestion of each of N groups, ``[N, B, M]``.
        log_prob: Of that suggestion under the policy, ``[N, B]``.
        temperature: Weight of the entropy, ``[]``.
        suggestions: K, of each group.

    Returns:
        ``[B, M]``: the mean over the groups, equation 8.
    """
    cost = temperature * (log_prob + log_advantage(suggestions))
    soft = (value - cost.unsqueeze(-1)).mean(0)
    return torch.addcmul(reward.unsqueeze(-1), discount.unsqueeze(-1), soft)
