"""Targets and advantages of a batch, by the networks before they learn from it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.returns import (
    bootstrap,
    correlation,
    explained_variance,
    lambda_estimates,
)
from a2s.learner.on_policy.state import TrainState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Targets:
    """Targets and advantages, and how well the critics foresaw them.

    The whole batch is new to Q and V, so what they explain of it is not memory.
    """

    advantage: Tensor  # of the executed suggestions, in returns, [N]
    target: Tensor  # what Q and V are to learn, in returns, [N]
    q_explained_variance: float  # of the target by Q; 0 where Q is not used
    q_action_correlation: float  # of Q - V and target - V; 0 where Q is not used
    value_explained_variance: float  # of the target by V


@torch.no_grad()
def estimate_targets(
    batch: Batch,
    state: TrainState,
    q_action: Tensor | None,
    *,
    gamma: float,
    gae_lambda: float,
    time_limit_is_terminal: bool = False,
) -> Targets:
    """Estimate advantages and targets with V as it is before its update.

    ``q_action`` are the executed actions as Q sees them, ``[N, A]``, or ``None`` where Q is not
    used. With ``gae_lambda = 1`` targets are discounted returns, and advantages those less V.
    """
    norm_obs = state.normaliser(torch.cat([batch.obs, batch.final_obs]))
    values = state.returns.restore(state.value_net(norm_obs).squeeze(1))
    value, final_value = values[: batch.num_steps], values[batch.num_steps :]
    after = bootstrap(batch, final_value, time_limit_is_terminal=time_limit_is_terminal)
    advantage, target = lambda_estimates(batch, value, after, gamma=gamma, lam=gae_lambda)
    q_variance = q_correlation = 0.0
    if q_action is not None:
        q_value = state.q_net(torch.cat([norm_obs[: batch.num_steps], q_action], 1))
        q_value = state.returns.restore(q_value.squeeze(1))
        q_variance = explained_variance(q_value, target)
        q_correlation = correlation(q_value - value, target - value)
    return Targets(
        advantage=advantage,
        target=target,
        q_explained_variance=q_variance,
        q_action_correlation=q_correlation,
        value_explained_variance=explained_variance(value, target),
    )
