"""Equation 6 in general: the mean is pulled to what Q prefers among K fresh suggestions."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.acting import as_q_sees, suggest

_BISECTIONS = 24


class Pull(NamedTuple):
    """What K suggestions in each of N states want the policy to be."""

    mean: Tensor  # [N, A]
    inverse_temperature: float  # per unit of Q's outputs
    act_inverse_temperature: float  # the same, of the actors
    share: float  # of the K that counts, mean over states


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

    The weights are ``softmax(factor * q / temperature)``; ``factor`` turns Q's outputs to
    deviations of the advantage (`Calibration`), and the temperature is raised until ``least_share``
    of the K counts; in the actors, which choose by the same softmax, ``act_least_share``.
    Observations are ``[N, D]``, means ``[N, A]``, deviations ``[A]``.

    The mean that they want is the policy's own, which is known, and what the weights' departure
    from 1/K adds to it.
    """
    normal = torch.randn(len(mean), suggestions, mean.shape[1], generator=generator)
    action = suggest(mean, std, normal)
    score = categorical.score(q_net, norm_obs, as_q_sees(action, "clip"))
    inverse = limited_inverse_temperature(score, factor / temperature, least_share)
    weight = (inverse * score).softmax(1)
    tilt = (weight - 1.0 / suggestions).unsqueeze(2)
    return Pull(
        mean + (tilt * action).sum(1),
        inverse,
        limited_inverse_temperature(score, inverse, act_least_share),
        share_that_counts(score, inverse),
    )


def share_that_counts(score: Tensor, inverse_temperature: float) -> float:
    """Effective number of the K by softmax weights over K, mean over states: ``[N, K]`` to 0..1.

    Source: Kish 1965, ``1 / sum w^2``.
    """
    below_best = score - score.amax(1, keepdim=True)
    weight = (inverse_temperature * below_best).exp()
    count = weight.sum(1).square() / weight.square().sum(1)
    return float(count.mean()) / score.shape[1]


def limited_inverse_temperature(score: Tensor, wanted: float, least_share: float) -> float:
    """The wanted one, or the largest at which ``least_share`` of the K counts: one for all states.

    Scores are ``[N, K]``.
    """
    if share_that_counts(score, wanted) >= least_share:
        return wanted
    low, high = 0.0, wanted
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if share_that_counts(score, middle) >= least_share:
            low = middle
        else:
            high = middle
    return low
