"""The policy suggests K actions, Q picks one.

Source: algorithm 1 of the paper, "for k = 1, K action suggestions".
"""

import math

import torch
from torch import Tensor

from a2s.learner.on_policy.config import ActionMode
from a2s.protocol.errors import A2SError

SPREAD_EPS = 1e-6
_LEAST_CHOOSY = 1e-3


def suggest(mean: Tensor, std: Tensor, normal: Tensor) -> Tensor:
    """Draw suggestions from the policy.

    Args:
        mean: Of the policy, canonical (-1..1 spans the action bounds), ``[B, A]``.
        std: Of the policy, ``[A]``.
        normal: Standard normal noise, ``[B, K, A]``. Zeros in place of a suggestion's noise make
            it the mean; the same noise for all K makes them one, whatever the selection.

    Returns:
        Suggestions, canonical and not clipped, ``[B, K, A]``.
    """
    return mean.unsqueeze(1) + std * normal


def as_q_sees(suggestion: Tensor, mode: ActionMode) -> Tensor:
    """Suggestions of any shape as the critics are given them: clipped to -1..1, or raw."""
    return suggestion.clamp(-1.0, 1.0) if mode == "clip" else suggestion


def select_hard(q_value: Tensor) -> Tensor:
    """Pick the suggestion of largest Q; among equals the first.

    Args:
        q_value: Scores, ``[B, K]``.

    Returns:
        Indices, int64 ``[B]``.

    Raises:
        A2SError: A score is not finite.
    """
    _require_finite(q_value)
    return q_value.argmax(1)


def select_soft(q_value: Tensor, gumbel: Tensor, temperature: float) -> Tensor:
    """Draw a suggestion by the softmax of Q in units of its own spread.

    ``argmax(z + gumbel)`` is a draw from ``softmax(z)``, with
    ``z = (q - mean q) / (std of q over K * temperature)``.

    Args:
        q_value: Scores, ``[B, K]``.
        gumbel: Standard Gumbel noise, ``[B, K]``; zeros give the suggestion of largest Q.
        temperature: Above 0.

    Returns:
        Indices, int64 ``[B]``.

    Raises:
        A2SError: A score is not finite.
    """
    _require_finite(q_value)
    return select_hard(_in_spreads(q_value, temperature) + gumbel)


def log_preference(q_value: Tensor, index: Tensor, temperature: float) -> Tensor:
    """How much likelier than a draw from the policy the soft selection made its choice, in logs.

    ``log(K p)``, p the chance of the chosen one given the K. An average over executed suggestions,
    each weighed by ``1 / (K p)``, is one over the policy: K drawn alike, each counted once.

    Args:
        q_value: Scores, ``[B, K]``.
        index: Chosen, ``[B]``.
        temperature: Above 0.

    Returns:
        Float32 ``[B]``; 0 where K is 1 or all scores are equal.
    """
    chance = _in_spreads(q_value, temperature).log_softmax(1)
    return chance.gather(1, index.unsqueeze(1)).squeeze(1) + math.log(q_value.shape[1])


def choosiness(progress: float, *, fades: bool) -> float:
    """How much soft selection counts: 1, or what is left of the run, but never quite nothing.

    Args:
        progress: Fraction of the run that is done, 0..1.
        fades: Whether it fades.
    """
    return max(1.0 - progress, _LEAST_CHOOSY) if fades else 1.0


def select_first(normal: Tensor) -> Tensor:
    """Pick the first suggestion: a uniform choice, since all K are drawn alike.

    This is how one acts while Q is untrained. The argmax of an untrained Q is no such choice: it
    prefers one arbitrary direction everywhere.

    Args:
        normal: The noise of the suggestions, ``[B, K, A]``.

    Returns:
        Indices, int64 ``[B]``.
    """
    return torch.zeros(len(normal), dtype=torch.int64, device=normal.device)


def take(candidate: Tensor, index: Tensor) -> Tensor:
    """Row by row the candidate of that index: ``[B, K, A]``, ``[B]`` to ``[B, A]``."""
    return candidate[torch.arange(len(index), device=index.device), index]


def _in_spreads(q_value: Tensor, temperature: float) -> Tensor:
    centred = q_value - q_value.mean(1, keepdim=True)
    spread = centred.square().mean(1, keepdim=True).sqrt()
    return centred / (spread * temperature + SPREAD_EPS)


def _require_finite(q_value: Tensor) -> None:
    if not bool(torch.isfinite(q_value).all()):
        bad = int((~torch.isfinite(q_value)).sum())
        raise A2SError(f"q scores: found {bad} non-finite of {q_value.numel()}, expected finite")
