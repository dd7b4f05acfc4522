"""What a batch says, judged by the networks before they learn from it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.returns import (
    bootstrap,
    correlation,
    explained_variance,
    lambda_estimates,
)
from a2s.learner.on_policy.state import Learned
from a2s.learner.on_policy.suggestion import as_q_sees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """Targets and advantages, and how well the critics foresaw them.

    The batch is new to Q and V, all its segments, so what they explain of it is not memory.

    Attributes:
        advantage: Of the executed suggestions, in returns, ``[N]``; by the rule ``gae``, or with
            the whole return for ``return-v``.
        target: What Q and V are to learn, in returns, ``[N]``.
        q_explained_variance: Of the target by Q; 0 where Q is not used.
        q_action_correlation: Of ``Q - V`` and ``target - V``; 0 where Q is not used.
        value_explained_variance: Of the target by V.
    """

    advantage: Tensor
    target: Tensor
    q_explained_variance: float
    q_action_correlation: float
    value_explained_variance: float


def q_input(batch: Batch, seen: Tensor, hyper: OnPolicyConfig) -> Tensor:
    """Normalised observations ``[N, D]`` joined with the executed actions: ``[N, D + A]``."""
    return torch.cat([seen, as_q_sees(batch.suggestion, hyper.action_mode)], 1)


@torch.no_grad()
def gather_evidence(batch: Batch, learned: Learned, hyper: OnPolicyConfig) -> Evidence:
    """Estimate advantages and targets with V as it is before its update."""
    seen = learned.normaliser(torch.cat([batch.obs, batch.final_obs]))
    values = learned.returns.restore(learned.value_net(seen).squeeze(1))
    value, final_value = values[: batch.num_steps], values[batch.num_steps :]
    after = bootstrap(batch, final_value, time_limit_is_terminal=hyper.time_limit_is_terminal)
    lam = 1.0 if hyper.advantage == "return-v" else hyper.gae_lambda
    advantage, target = lambda_estimates(batch, value, after, gamma=hyper.gamma, lam=lam)
    if lam != hyper.gae_lambda:
        _, target = lambda_estimates(batch, value, after, gamma=hyper.gamma, lam=hyper.gae_lambda)
    q_variance = q_correlation = 0.0
    if hyper.uses_q:
        q_value = learned.q_net(q_input(batch, seen[: batch.num_steps], hyper)).squeeze(1)
        q_value = learned.returns.restore(q_value)
        q_variance = explained_variance(q_value, target)
        q_correlation = correlation(q_value - value, target - value)
    return Evidence(
        advantage=advantage,
        target=target,
        q_explained_variance=q_variance,
        q_action_correlation=q_correlation,
        value_explained_variance=explained_variance(value, target),
    )
