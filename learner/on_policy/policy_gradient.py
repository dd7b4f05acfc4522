"""The policy gradient: advantages, losses, and the passes over the batch."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import HALF_LOG_2PI, Policy, log_density
from a2s.learner.on_policy.config import OnPolicyConfig, PolicyLoss
from a2s.learner.on_policy.fit import num_chunks
from a2s.learner.on_policy.returns import RESOLUTION
from a2s.learner.on_policy.step_size import gaussian_kl

# Reached only by suggestions that no policy makes: 0 / 0 and infinity * 0 would end the learning.
LEAST_WEIGHT, MOST_LOG_RATIO = 1e-30, 20.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolicyData:
    """What the policy learns from.

    Attributes:
        obs: Normalised, ``[N, D]``.
        action: Executed suggestions, not clipped, ``[N, A]``.
        log_prob: Their log density under the policy before the update, ``[N]``.
        advantage: ``[N]``.
        weight: Importance of each for an average over that policy, ``[N]``.
        mean: Of the policy that the KL divergence is measured from, ``[N, A]``.
        log_std: Of the same policy, ``[A]``.
    """

    obs: Tensor
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    weight: Tensor
    mean: Tensor
    log_std: Tensor


class Improvement(NamedTuple):
    """Mean loss of the last pass, passes made, and the KL divergence after it, joint."""

    policy_loss: float
    epochs: int
    kl: float


def entropy(log_std: Tensor) -> Tensor:
    """Differential entropy of the policy in nats, a scalar; the same in every state."""
    return (log_std + HALF_LOG_2PI + 0.5).sum()


def importance(log_prob: Tensor, executed_log_prob: Tensor, limit: float) -> Tensor:
    """Weights, with mean 1, that make an average over executed suggestions one over the policy.

    What Q prefers is executed more often than the policy draws it; unless that is undone, the
    gradient of its density pulls wherever Q points, good or not, and shrinks the deviation.

    Args:
        log_prob: Under the policy, ``[N]``.
        executed_log_prob: With the selection, ``[N]``.
        limit: Greatest weight before they are brought to mean 1; 0: all are 1.

    Source: Hilton et al. 2021, "Batch size-invariance for policy optimization": the
    policy that the ratio is clipped around need not be the one that acted.
    """
    if limit == 0:
        return torch.ones_like(log_prob)
    weight = (log_prob - executed_log_prob).exp().clamp(max=limit)
    return weight / weight.mean().clamp(min=LEAST_WEIGHT)


def normalised(advantage: Tensor, weight: Tensor) -> Tensor:
    """Advantages of a batch with weighted mean 0 and standard deviation 1; 0 if all are alike."""
    given = advantage.double()
    centred = given - (weight * given).mean()
    floor = RESOLUTION * given.square().mean().sqrt()
    spread = (weight * centred.square()).mean().sqrt().clamp(min=floor)
    return (centred / spread.clamp(min=LEAST_WEIGHT)).to(advantage.dtype)


def policy_loss(
    kind: PolicyLoss,
    log_prob: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    weight: Tensor,
    clip: float,
) -> tuple[Tensor, Tensor]:
    """Loss whose gradient is minus the policy gradient.

    Args:
        kind: ``score`` or ``clip``.
        log_prob: Of the present policy, ``[M]``.
        old_log_prob: Of the policy before the update, ``[M]``; only ``clip`` reads it.
        advantage: ``[M]``.
        weight: Importance of each, ``[M]``.
        clip: Epsilon of ``clip``.

    Returns:
        The loss, a scalar, and its derivative by ``log_prob``, ``[M]``.

    Source: equation 4 of the paper (``score``; the authors' mean over dimensions differs by a
    factor, which Adam undoes); Schulman et al. 2017, equation 7 (``clip``).
    """
    worth = weight * advantage
    if kind == "score":
        return -(worth * log_prob).mean(), worth / -worth.numel()
    ratio = (log_prob - old_log_prob).clamp(max=MOST_LOG_RATIO).exp()
    free = ratio * worth
    limited = ratio.clamp(1.0 - clip, 1.0 + clip) * worth
    slope = free * (free <= limited) / -free.numel()
    return -torch.minimum(free, limited).mean(), slope


@torch.no_grad()
def joint_kl(policy: Policy, data: PolicyData) -> float:
    """Mean over the batch of KL(policy || the one that the data remembers), nats."""
    kl = gaussian_kl(policy(data.obs), policy.log_std, data.mean, data.log_std)
    return float(kl.sum(1).mean())


def improve(
    policy: Policy,
    optimiser: Adam,
    data: PolicyData,
    hyper: OnPolicyConfig,
    *,
    learning_rate: float,
    generator: torch.Generator,
) -> Improvement:
    """Pass over the batch until the passes are made or the policy has moved far enough.

    Args:
        policy: Changed in place.
        optimiser: Of the policy gradient.
        data: The batch.
        hyper: Loss, passes, minibatch, weights and bounds.
        learning_rate: Of Adam.
        generator: Draws the order, unless the whole batch is one step.
    """
    count = num_chunks(len(data.obs), hyper.policy_minibatch, hyper.min_minibatches)
    total, kl, passes = torch.zeros(()), 0.0, 0
    while passes < hyper.policy_epochs and kl <= hyper.kl_stop:
        passes += 1
        total.zero_()
        for part in _minibatches(data, count, generator):
            mean, tape = policy.trace(part.obs)
            loss, by_mean, by_log_std = differentiate(mean, policy.log_std, part, hyper)
            policy.differentiate(tape, by_mean, by_log_std)
            optimiser.step(policy.grad, learning_rate, hyper.max_grad_norm)
            policy.hold_floor()
            total += loss
        kl = joint_kl(policy, data)
    return Improvement(float(total / count), passes, kl)


@torch.no_grad()
def differentiate(
    mean: Tensor, log_std: Tensor, part: PolicyData, hyper: OnPolicyConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """What a policy loses on some data, and how that changes with the policy.

    Args:
        mean: Of the policy on the data, ``[M, A]``.
        log_std: Of the policy, ``[A]``.
        part: The data.
        hyper: Kinds of loss, and weights.

    Returns:
        The loss of the policy gradient, a scalar; the gradient of it less the weighted entropy, by
        the mean, ``[M, A]``, and by the log deviation, ``[A]``.
    """
    factor = (-log_std).exp()
    z = (part.action - mean) * factor
    log_prob = log_density(z, log_std)
    loss, slope = policy_loss(
        hyper.policy_loss, log_prob, part.log_prob, part.advantage, part.weight, hyper.clip_ratio
    )
    steep = slope.unsqueeze(1)
    by_log_std = (steep * z.square()).sum(0) - slope.sum() - hyper.entropy_weight
    return loss, steep * z * factor, by_log_std


def _minibatches(data: PolicyData, count: int, generator: torch.Generator) -> list[PolicyData]:
    """One pass over the data in a new order; the data itself where it is one step."""
    if count == 1:
        return [data]
    order = torch.randperm(len(data.obs), generator=generator)
    return [
        PolicyData(
            obs=obs,
            action=action,
            log_prob=log_prob,
            advantage=advantage,
            weight=weight,
            mean=mean,
            log_std=data.log_std,
        )
        for obs, action, log_prob, advantage, weight, mean in zip(
            data.obs[order].tensor_split(count),
            data.action[order].tensor_split(count),
            data.log_prob[order].tensor_split(count),
            data.advantage[order].tensor_split(count),
            data.weight[order].tensor_split(count),
            data.mean[order].tensor_split(count),
            strict=True,
        )
    ]
