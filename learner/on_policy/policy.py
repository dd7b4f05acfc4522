"""The policy gradient: densities, weights, PPO's loss, and the passes over the batch.

With one pass over the whole batch at once it is A2C's gradient, see `clipped_loss`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import HALF_LOG_2PI, Policy, log_density
from a2s.learner.on_policy.critics import num_minibatches
from a2s.learner.on_policy.returns import RESOLUTION

# Reached only by suggestions that no policy makes: 0 / 0 and infinity * 0 would end the learning.
MIN_WEIGHT, MAX_LOG_RATIO = 1e-30, 20.0
_BY_ROW = ("obs", "action", "log_prob", "advantage", "weight", "mean", "wanted")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolicyData:
    """What the policy learns from: N steps, and the policy before the update."""

    obs: Tensor  # normalised, [N, D]
    action: Tensor  # executed suggestions, not clipped, [N, A]
    log_prob: Tensor  # their log density under the policy before the update, [N]
    advantage: Tensor  # [N]
    weight: Tensor  # importance of each for an average over that policy, [N]
    mean: Tensor  # of that policy, [N, A]
    log_std: Tensor  # of that policy, [A]
    wanted: Tensor | None = None  # what suggestions want the mean to be, [N, A]; None: no pull


class PolicyChange(NamedTuple):
    """What the policy gradient did."""

    policy_loss: float = 0.0  # mean of the last pass
    policy_epochs: int = 0
    kl: float = 0.0  # from the policy before, nats
    advantage_std: float = 0.0  # in returns, before the advantages are normalised
    distil_loss: float = 0.0  # of equation 6, as policy_loss
    distil_steps: int = 0


def entropy(log_std: Tensor) -> Tensor:
    """Differential entropy of the policy in nats, a scalar; the same in every state."""
    return (log_std + HALF_LOG_2PI + 0.5).sum()


def gaussian_kl(mean: Tensor, log_std: Tensor, old_mean: Tensor, old_log_std: Tensor) -> Tensor:
    """KL(new || old) of diagonal Gaussians in nats, by dimension: ``[N, A]``.

    Means are ``[N, A]``, deviations ``[A]``. The sum over A is the divergence of the joint density.
    """
    change = log_std - old_log_std
    apart = ((mean - old_mean) * (-old_log_std).exp()).square()
    return 0.5 * (torch.expm1(2.0 * change) + apart) - change


def importance(log_prob: Tensor, executed_log_prob: Tensor, limit: float) -> Tensor:
    """Weights, with mean 1, that make an average over executed suggestions one over the policy.

    What Q prefers is executed more often than the policy draws it; unless that is undone, the
    gradient of its density pulls wherever Q points, good or not, and shrinks the deviation.

    Densities, under the policy and as executed with the selection, and weights are ``[N]``. No
    weight is above ``limit`` before they are brought to mean 1; with 0 all are 1.

    Source: Hilton et al. 2021, "Batch size-invariance for policy optimization": the
    policy that the ratio is clipped around need not be the one that acted.
    """
    if limit == 0:
        return torch.ones_like(log_prob)
    weight = (log_prob - executed_log_prob).exp().clamp(max=limit)
    return weight / weight.mean().clamp(min=MIN_WEIGHT)


def normalised(advantage: Tensor, weight: Tensor) -> Tensor:
    """Advantages of a batch with weighted mean 0 and standard deviation 1; 0 if all are alike."""
    given = advantage.double()
    centred = given - (weight * given).mean()
    floor = RESOLUTION * given.square().mean().sqrt()
    spread = (weight * centred.square()).mean().sqrt().clamp(min=floor)
    return (centred / spread.clamp(min=MIN_WEIGHT)).to(advantage.dtype)


def clipped_loss(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, weight: Tensor, clip: float
) -> tuple[Tensor, Tensor]:
    """Loss whose gradient is minus the policy gradient, the ratio of densities clipped.

    In the first step the ratio is 1 and the gradient that of ``-log_prob * advantage``, which is
    A2C's loss: equation 4 of the paper. ``policy_epochs=1`` and ``policy_minibatch=0`` make no
    other step.

    Returns:
        The loss, a scalar, and its derivative by ``log_prob``, ``[M]`` like the arguments.

    Source: Schulman et al. 2017, equation 7.
    """
    worth = weight * advantage
    ratio = (log_prob - old_log_prob).clamp(max=MAX_LOG_RATIO).exp()
    free = ratio * worth
    limited = ratio.clamp(1.0 - clip, 1.0 + clip) * worth
    slope = free * (free <= limited) / -free.numel()
    return -torch.minimum(free, limited).mean(), slope


def improve(
    policy: Policy,
    optimiser: Adam,
    data: PolicyData,
    *,
    epochs: int,
    minibatch: int,
    min_minibatches: int,
    kl_stop: float,
    clip_ratio: float,
    entropy_weight: float,
    pull: float,
    std_floor: float,
    learning_rate: float,
    max_grad_norm: float,
    generator: torch.Generator,
) -> PolicyChange:
    """Pass over the batch until the passes are made or the policy has moved far enough.

    No pass begins when the KL divergence, joint, is above ``kl_stop`` nats. A ``minibatch`` of 0 is
    the whole batch, in its order; ``max_grad_norm`` 0: not limited.
    """
    count = num_minibatches(len(data.obs), minibatch, min_minibatches)
    total, kl, passes = torch.zeros(2), 0.0, 0
    while passes < epochs and kl <= kl_stop:
        passes += 1
        total.zero_()
        for part in _minibatches(data, count, generator):
            mean, tape = policy.trace(part.obs)
            loss, grad_mean, grad_log_std = differentiate(
                mean, policy.log_std, part, clip_ratio, entropy_weight
            )
            if part.wanted is not None:
                apart = pull_loss(mean, policy.log_std, part.wanted, part.log_std)
                grad_mean += pull * apart.by_mean
                grad_log_std += pull * apart.by_log_std
                total[1] += apart.loss
            policy.differentiate(tape, grad_mean, grad_log_std)
            optimiser.step(policy.grad, learning_rate, max_grad_norm)
            policy.hold_floor(std_floor)
            total[0] += loss
        with torch.no_grad():
            moved = gaussian_kl(policy(data.obs), policy.log_std, data.mean, data.log_std)
            kl = float(moved.sum(1).mean())
    policy_loss, distil_loss = (total / count).tolist()
    steps = passes * count if data.wanted is not None else 0
    return PolicyChange(policy_loss, passes, kl, distil_loss=distil_loss, distil_steps=steps)


@torch.no_grad()
def differentiate(
    mean: Tensor, log_std: Tensor, part: PolicyData, clip_ratio: float, entropy_weight: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss of a policy on some data, by its means ``[M, A]`` and log deviation, and its gradient.

    Returns:
        The loss without the bonus, a scalar; the gradient of the loss less the bonus by the mean,
        ``[M, A]``, and by the log deviation, ``[A]``.
    """
    factor = (-log_std).exp()
    z = (part.action - mean) * factor
    log_prob = log_density(z, log_std)
    loss, slope = clipped_loss(log_prob, part.log_prob, part.advantage, part.weight, clip_ratio)
    steep = slope.unsqueeze(1)
    grad_log_std = (steep * z.square()).sum(0) - slope.sum() - entropy_weight
    return loss, steep * z * factor, grad_log_std


class PullLoss(NamedTuple):
    """The loss of equation 6, and its gradient."""

    loss: Tensor  # a scalar
    by_mean: Tensor  # [M, A]
    by_log_std: Tensor  # [A]


@torch.no_grad()
def pull_loss(mean: Tensor, log_std: Tensor, wanted: Tensor, old_log_std: Tensor) -> PullLoss:
    """KL(wanted || policy) in nats, mean over states: means ``[M, A]``, log deviations ``[A]``.

    What is wanted has the deviation of the policy before: equation 6 is about the mean.
    """
    precision = (-2.0 * log_std).exp()
    apart = mean - wanted
    normal = precision * ((2.0 * old_log_std).exp() + apart.square())
    loss = (0.5 * (normal - 1.0) + log_std - old_log_std).sum(1).mean()
    return PullLoss(loss, precision * apart / len(mean), (1.0 - normal).mean(0))


def _minibatches(data: PolicyData, count: int, generator: torch.Generator) -> Iterator[PolicyData]:
    """One pass over the data in a new order; the data itself where it is one step."""
    if count == 1:
        yield data
        return
    order = torch.randperm(len(data.obs), generator=generator)
    names = [name for name in _BY_ROW if getattr(data, name) is not None]
    parts = [getattr(data, name)[order].tensor_split(count) for name in names]
    for part in zip(*parts, strict=True):
        yield replace(data, **dict(zip(names, part, strict=True)))
