"""Returns, advantages and targets over segments that lie one after the other."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.on_policy import fit_kernels
from a2s.learner.on_policy.batch import Batch

# Of the size of returns: what varies less is rounding of float32 numbers and their sums.
RESOLUTION = 2.0**-20
_MIN_STD = 1e-30  # what float32 can still be divided by


class Estimates(NamedTuple):
    """Advantage and target of every step, float32 ``[N]`` each."""

    advantage: Tensor
    target: Tensor


def decayed_sums(amount: Tensor, decay: Tensor) -> Tensor:
    """Solve ``y[t] = amount[t] + decay[t] * y[t + 1]`` from the end, in double precision.

    All are ``[N]``; the decay is 0 at the last step of every segment.
    """
    sums = amount.double().numpy().copy()
    fit_kernels.add_decayed(sums, decay.double().numpy())
    return torch.from_numpy(sums).float()


def bootstrap(batch: Batch, final_value: Tensor, *, time_limit_is_terminal: bool) -> Tensor:
    """Expected return after each segment, ``[S]``: 0 once terminated, else V(final_obs).

    With ``time_limit_is_terminal``, the authors' way, it is 0 for a truncated segment too. A cut
    one is always bootstrapped.
    """
    over = batch.terminated | batch.truncated if time_limit_is_terminal else batch.terminated
    return final_value.masked_fill(over, 0.0)


def lambda_estimates(
    batch: Batch, value: Tensor, after: Tensor, *, gamma: float, lam: float
) -> Estimates:
    """Generalised advantage estimates, and TD(lambda) targets, which are those plus the values.

    With ``lam = 1`` the target is the discounted return, bootstrapped where a segment was cut.

    ``value`` is V of every observation before its update, ``[N]``, ``after`` from `bootstrap`.

    Source: r^gamma of section 4.1 of the paper for ``lam = 1``; else Schulman et al. 2016, eq. 16.
    """
    last = batch.last
    following = torch.cat([value[1:], value.new_zeros(1)])
    following[last] = after
    surprise = batch.reward + gamma * following - value
    decay = torch.full_like(value, gamma * lam)
    decay[last] = 0.0
    advantage = decayed_sums(surprise, decay)
    return Estimates(advantage, advantage + value)


def v_trace(
    batch: Batch, value: Tensor, after: Tensor, ratio: Tensor, *, gamma: float, lam: float
) -> Tensor:
    """Targets of Q of the executed actions under a policy that did not play all of the batch.

    ``value`` is V of every observation, ``after`` from `bootstrap`, ``ratio`` the policy's density
    over the executed one, all ``[N]`` like the targets. Where the ratios are 1 the targets are
    those of `lambda_estimates`.

    Source: Espeholt et al. 2018, "IMPALA", equation 1, and what remark 1 says of lambda; of Q
    section 4.2: the reward, and the discounted target of what follows.
    """
    last = batch.last
    following = torch.cat([value[1:], value.new_zeros(1)])
    following[last] = after
    ahead = batch.reward + gamma * following
    limited = ratio.clamp(max=1.0)
    decay = gamma * lam * limited
    decay[last] = 0.0
    correction = decayed_sums(limited * (ahead - value), decay)
    next_correction = torch.cat([correction[1:], correction.new_zeros(1)])
    next_correction[last] = 0.0
    return ahead + gamma * lam * next_correction


class ReturnScale:
    """Running mean and standard deviation of targets, the unit in which Q and V are trained.

    Call `update` between the use of the old predictions and the next fit: the outputs of networks
    are in the unit of their last fit. When not ``enabled`` the mean stays 0 and the standard
    deviation 1. About ``window_steps`` steps are remembered.
    """

    def __init__(self, *, enabled: bool, window_steps: int) -> None:
        self.enabled = enabled
        self.window_steps = window_steps
        self.mean, self.std, self.count = 0.0, 1.0, 0.0

    def update(self, target: Tensor) -> None:
        """Take targets, ``[N]``, into account."""
        if not self.enabled:
            return
        target = target.double()
        mean, added = float(target.mean()), float(len(target))
        variance = float(target.var(correction=0))
        total = self.count + added
        shift = mean - self.mean
        kept = self.std**2 * self.count if self.count else 0.0
        spread = kept + variance * added + shift**2 * self.count * added / total
        self.mean += shift * added / total
        self.std = max((spread / total) ** 0.5, RESOLUTION * abs(self.mean), _MIN_STD)
        self.count = min(total, float(self.window_steps))

    def normalise(self, target: Tensor) -> Tensor:
        """Returns to targets of the networks."""
        return (target - self.mean) / self.std

    def restore(self, value: Tensor) -> Tensor:
        """Outputs of the networks to returns."""
        return value * self.std + self.mean

    def state(self) -> dict[str, float]:
        """All that changes."""
        return {"mean": self.mean, "std": self.std, "count": self.count}

    def load(self, state: dict[str, float]) -> None:
        """Go back to a state."""
        self.mean, self.std, self.count = state["mean"], state["std"], state["count"]


def explained_variance(predicted: Tensor, actual: Tensor) -> float:
    """``1 - var(actual - predicted) / var(actual)``: 1 is perfect, 0 no better than a constant."""
    predicted, actual = predicted.double(), actual.double()
    variance = float(actual.var(correction=0))
    if variance <= RESOLUTION**2 * float(actual.square().mean()):
        return 0.0
    return 1.0 - float((actual - predicted).var(correction=0)) / variance


def correlation(left: Tensor, right: Tensor) -> float:
    """Pearson's correlation of two ``[N]``; 0 where one of them does not vary."""
    left, right = left.double(), right.double()
    least = RESOLUTION * left.norm(), RESOLUTION * right.norm()
    left, right = left - left.mean(), right - right.mean()
    if left.norm() <= least[0] or right.norm() <= least[1]:
        return 0.0
    return float((left / left.norm()) @ (right / right.norm()))
