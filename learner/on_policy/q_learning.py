"""What Q learns: Retrace on the window of latest batches, under the present policy."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy.acting import as_q_sees, score_in_parts, suggest
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.returns import bootstrap, explained_variance, retrace
from a2s.learner.on_policy.state import TrainState

OUTPUT_STD = 3.0  # of Q's outputs: their range is four deviations of the returns to either side


class QTargets(NamedTuple):
    """Inputs of Q for every step of the window, and what it is to answer."""

    inputs: Tensor  # [N, D + A]
    predicted: Tensor  # by Q before it learns from them, in returns, [N]
    target: Tensor  # in returns, [N]

    def explained_variance(self, newest: int) -> float:
        """What Q foresaw of the targets of the newest steps, which it had not seen."""
        return explained_variance(self.predicted[-newest:], self.target[-newest:])


@torch.no_grad()
def q_targets(
    window: Batch,
    state: TrainState,
    *,
    gamma: float,
    retrace_lambda: float,
    draws: int,
    generator: torch.Generator,
) -> QTargets:
    """Estimate what each executed action of the window is worth under the present policy.

    The value of a state is the mean of Q over ``draws`` actions of the policy.
    """
    steps = window.num_steps
    norm_obs = state.normaliser(torch.cat([window.obs, window.final_obs]))
    mean = state.policy(norm_obs)
    normal = torch.randn(len(mean), draws, mean.shape[1], generator=generator)
    drawn = suggest(mean, state.policy.std(), normal)
    executed = torch.cat([window.suggestion, mean[steps:]])  # the latter are not read
    action = as_q_sees(torch.cat([drawn, executed.unsqueeze(1)], 1), "clip")
    scores = in_returns(state, score_in_parts(state.q_net, norm_obs, action))
    value, q_value = scores[:, :draws].mean(1), scores[:steps, draws]
    log_std = state.policy.log_std
    apart = (window.suggestion - mean[:steps]) * (-log_std).exp()
    target = retrace(
        window,
        q_value,
        value[:steps],
        bootstrap(window, value[steps:], time_limit_is_terminal=False),
        (log_density(apart, log_std) - window.log_prob).exp(),
        gamma=gamma,
        lam=retrace_lambda,
    )
    return QTargets(torch.cat([norm_obs[:steps], action[:steps, draws]], 1), q_value, target)


def advantage_over_mean(state: TrainState, norm_obs: Tensor, action: Tensor) -> Tensor:
    """By how much Q finds an action better than the mean action, in returns.

    Observations ``[N, D]`` and suggestions ``[N, A]`` to ``[N]``.
    """
    both = as_q_sees(torch.stack([action, state.policy(norm_obs)], 1), "clip")
    score = score_in_parts(state.q_net, norm_obs, both)
    return (score[:, 0] - score[:, 1]) * (state.returns.std / OUTPUT_STD)


def in_returns(state: TrainState, output: Tensor) -> Tensor:
    """Outputs of Q to returns."""
    return state.returns.restore(output / OUTPUT_STD)


def in_outputs(state: TrainState, returns: Tensor) -> Tensor:
    """Returns to outputs of Q."""
    return state.returns.normalise(returns) * OUTPUT_STD
