"""Gradients that move the policy of off-policy A2S, each by the output of its network.

Source: SAC (Haarnoja et al. 2018), equation 9, for `pathwise`; equations 3 and 4 of the paper for
`score`.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.off_policy.squashed import Drawn, Gaussian


class PolicyStep(NamedTuple):
    """A loss, a mean over the batch, ``[]``, and its gradient by the network's output."""

    loss: Tensor
    grad: Tensor


def advantage_over_others(q_value: Tensor) -> Tensor:
    """How much better each suggestion is than the mean of the others: ``[N, K]`` to ``[N, K]``.

    With suggestions drawn from the policy, ``mean_k grad log pi(u_k) * advantage_k`` is an
    unbiased policy gradient, given Q: the baseline of a suggestion does not depend on it.
    """
    count = q_value.shape[1]
    if count == 1:
        return torch.zeros_like(q_value)
    return (q_value - q_value.mean(1, keepdim=True)) * (count / (count - 1))


def pathwise(
    policy: Gaussian, drawn: Drawn, q_value: Tensor, action_grad: Tensor, temperature: Tensor
) -> PolicyStep:
    """Move the one suggestion of every state along the gradient of Q: SAC's loss.

    Values of the suggestions are ``[B]``, the gradient of their sum by the suggestions ``[B, A]``.
    ``temperature`` is the weight of the entropy, ``[]``.
    """
    action, rows = drawn.action, len(drawn.action)
    share = temperature / rows
    u_grad = 2.0 * share * action - action_grad * ((1.0 - action.square()) / rows)
    grad = torch.cat([u_grad, (u_grad * drawn.noise - share) * policy.free], dim=-1)
    return PolicyStep((temperature * drawn.log_prob - q_value).mean(), grad)


def score(policy: Gaussian, normal: Tensor, q_value: Tensor, temperature: Tensor) -> PolicyStep:
    """Make suggestions likelier that are better than the mean of the others.

    The noise of K suggestions is ``[B, K, A]``, their values ``[B, K]``. ``temperature``, ``[]``,
    is the weight of the entropy, which counts as a part of the value.
    """
    log_std = policy.log_std.unsqueeze(1)
    std = log_std.exp()
    log_prob = log_density(normal, log_std, policy.mean.unsqueeze(1) + std * normal)
    advantage = advantage_over_others(q_value - temperature * log_prob)
    pull = (advantage / advantage.numel()).unsqueeze(-1)
    mean_grad = -(pull * normal / std).sum(1)
    log_std_grad = -(pull * (normal.square() - 1.0)).sum(1) * policy.free
    grad = torch.cat([mean_grad, log_std_grad], dim=-1)
    return PolicyStep(-(advantage * log_prob).mean(), grad)
