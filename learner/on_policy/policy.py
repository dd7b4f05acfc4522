"""The policy gradient: densities, weights, PPO's loss, and the passes over the batch.

With one pass over the whole batch at once it is A2C's gradient, see `fit_kernels.clipped_loss`.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.compiled import outputs, run_together, vectors
from a2s.learner.networks.gaussian import HALF_LOG_2PI, Policy
from a2s.learner.on_policy import fit_kernels
from a2s.learner.on_policy.critics import bounds, num_minibatches
from a2s.learner.on_policy.returns import RESOLUTION

# Reached only by suggestions that no policy makes: 0 / 0 would end the learning.
MIN_WEIGHT = 1e-30


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

    def learned_from(self) -> tuple[Tensor, ...]:
        """As the compiled passes have it."""
        return self.obs, self.action, self.log_prob, self.advantage, self.weight


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
    ends, net = bounds(len(data.obs), count), vectors(optimiser, policy.network, policy.grad)
    how = fit_kernels.Surrogate(
        clip_ratio, entropy_weight, pull, math.log(std_floor) if std_floor > 0 else -math.inf
    )
    wanted = data.obs[:0] if data.wanted is None else data.wanted
    arrays = tuple(each.numpy() for each in data.learned_from())
    losses, kl, passes = (0.0, 0.0), 0.0, 0
    while passes < epochs and kl <= kl_stop:
        order = torch.arange(len(data.obs))
        if count > 1:
            order = torch.randperm(len(data.obs), generator=generator)
        run = partial(
            fit_kernels.policy_pass, net, arrays, wanted.numpy(), how, order.numpy(), ends,
            int(optimiser.steps), learning_rate, max_grad_norm,
        )  # fmt: skip
        (losses,) = run_together([run])
        optimiser.steps += count
        passes += 1
        (mean,) = outputs((policy.network, data.obs))
        moved = gaussian_kl(mean, policy.log_std, data.mean, data.log_std)
        kl = float(moved.sum(1).mean())
    policy_loss, pull_loss = (each / count for each in losses)
    steps = passes * count if data.wanted is not None else 0
    return PolicyChange(policy_loss, passes, kl, distil_loss=pull_loss, distil_steps=steps)
