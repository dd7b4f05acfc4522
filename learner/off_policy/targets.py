"""Equations 7 and 8: the value of the best of K suggestions in the next state.

One critic selects, others evaluate: the maximum over K of a noisy estimate, evaluated by itself,
exceeds the truth by 1.5 standard deviations of the noise at K = 10.

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
    """Take from each of the ``candidates [..., K, A]`` the entry of largest score, ``[..., A]``.

    Scores are ``[..., K]``; among equals the first counts.
    """
    best = score.argmax(-1)[..., None, None]
    return [
        candidate.gather(-2, best.expand(*best.shape[:-1], candidate.shape[-1])).squeeze(-2)
        for candidate in candidates
    ]


def evaluate(q_value: Tensor, dropped: int) -> Tensor:
    """One value, or one set of atoms, from those of all target critics, ``[E, ..., M]``.

    M is 1 for plain critics. Of quantile critics ``dropped`` atoms per critic are left out, the
    largest of all.

    Returns:
        Plain: the minimum over the critics, ``[..., 1]``. Quantiles: the remaining of all ``E M``
        atoms, ascending, ``[..., E (M - dropped)]``.

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
    """Targets of the critics, ``[B, M]``: the mean over the N groups of K suggestions, equation 8.

    Rewards and discounts are ``[B]``, discounts 0 after a terminal state. The value of the best
    suggestion of each group is ``[N, B, M]``, its log density under the policy ``[N, B]``.
    ``temperature`` is the weight of the entropy, ``[]``.
    """
    cost = temperature * (log_prob + log_advantage(suggestions))
    soft = (value - cost.unsqueeze(-1)).mean(0)
    return torch.addcmul(reward.unsqueeze(-1), discount.unsqueeze(-1), soft)
