"""Equation 6 in general: the mean is pulled to what Q prefers among K fresh suggestions."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy import categorical, fit_kernels
from a2s.learner.on_policy.acting import as_q_sees, suggest

_BISECTIONS = 24
_MOST_DEVIATIONS = 100.0  # of scores, by the temperature: the best of the K alone counts there


class Pull(NamedTuple):
    """What K suggestions in each of N states want the policy to be, and how much that counts."""

    mean: Tensor  # [N, A]
    strength: float  # 0: Q is worth nothing; 1: it is trusted as far as it may be
    inverse_temperature: float  # at which the K are weighed, per unit of Q's outputs
    act_inverse_temperature: float  # the same, of the actors


@torch.no_grad()
def pull_of_suggestions(
    q_net: Ensemble,
    norm_obs: Tensor,
    mean: Tensor,
    std: Tensor,
    *,
    suggestions: int,
    factor: float,
    temperature: float,
    least_share: float,
    act_least_share: float,
    generator: torch.Generator,
) -> Pull:
    """Draw K actions of the policy in every state, and weigh them by what Q says.

    The weights are ``softmax(q / T)``, T being the one temperature at which ``least_share`` of the
    K counts: so far the mean is pulled. ``strength`` is how much that counts: T by the temperature
    that Q deserves, ``temperature / factor``, at most 1. ``factor`` turns Q's outputs to deviations
    of the advantage, as far as they were seen to be true (`Calibration`). Actors choose by the
    softmax at the temperature that Q deserves, or at the higher one at which ``act_least_share`` of
    the K counts. Observations are ``[N, D]``, means ``[N, A]``, deviations ``[A]``.

    The mean that they want is the policy's own, which is known, and what the weights' departure
    from 1/K adds to it.
    """
    normal = torch.randn(len(mean), suggestions, mean.shape[1], generator=generator)
    action = suggest(mean, std, normal)
    score = categorical.score(q_net, norm_obs, as_q_sees(action, "clip"))
    deserved = factor / temperature
    most = inverse_temperature_at(score, least_share)
    weight = (most * score).softmax(1)
    tilt = (weight - 1.0 / suggestions).unsqueeze(2)
    return Pull(
        mean + (tilt * action).sum(1),
        min(deserved / most, 1.0) if most > 0 else 0.0,
        most,
        inverse_temperature_at(score, act_least_share, at_most=deserved),
    )


def share_that_counts(score: Tensor, inverse_temperature: float) -> float:
    """Effective number of the K by softmax weights over K, mean over states: ``[N, K]`` to 0..1.

    Source: Kish 1965, ``1 / sum w^2``.
    """
    return float(fit_kernels.share_that_counts(score.contiguous().numpy(), inverse_temperature))


def inverse_temperature_at(
    score: Tensor, least_share: float, *, at_most: float | None = None
) -> float:
    """The largest at which ``least_share`` of the K counts, one for all states; scores ``[N, K]``.

    It is searched for only where that is less than ``at_most``. 0 where all scores are alike.
    """
    spread = float((score - score.mean(1, keepdim=True)).square().mean().sqrt())
    if spread == 0.0:
        return 0.0
    if at_most is not None and share_that_counts(score, at_most) >= least_share:
        return at_most
    low, high = 0.0, _MOST_DEVIATIONS / spread
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if share_that_counts(score, middle) >= least_share:
            low = middle
        else:
            high = middle
    return low
