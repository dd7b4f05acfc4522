"""What happens to the policy in an update: equation 6, then the policy gradient."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.distil import distil_policy, distil_target
from a2s.learner.on_policy.policy_gradient import (
    Improvement,
    PolicyData,
    importance,
    improve,
    normalised,
)
from a2s.learner.on_policy.state import Learned
from a2s.learner.on_policy.targets import Evidence, q_input


class PolicyNow(NamedTuple):
    """A policy on a batch, kept: mean ``[N, A]`` and log standard deviation ``[A]``."""

    mean: Tensor
    log_std: Tensor


class PolicyUpdate(NamedTuple):
    """What equation 6 and the policy gradient did."""

    improvement: Improvement = Improvement(0.0, 0, 0.0)
    distil_loss: float = 0.0
    distil_steps: int = 0
    advantage_std: float = 0.0


@torch.no_grad()
def policy_now(learned: Learned, obs: Tensor) -> PolicyNow:
    """Keep the present policy on a batch: observations as the environment gave them."""
    policy = learned.policy
    return PolicyNow(policy(learned.normaliser(obs)), policy.log_std.clone())


def update_policy(
    batch: Batch,
    seen: Tensor,
    evidence: Evidence,
    collected: PolicyNow,
    learned: Learned,
    hyper: OnPolicyConfig,
    *,
    distil: bool,
    learning_rate: float,
    order: torch.Generator,
    q_order: torch.Generator,
) -> PolicyUpdate:
    """Distil what Q picks, then follow the policy gradient.

    Args:
        batch: Gives the executed suggestions.
        seen: Normalised observations, ``[N, D]``.
        evidence: Gives the advantages.
        collected: The policy that made the batch.
        learned: The policy is changed in place.
        hyper: Kinds, weights, passes and bounds.
        distil: Q is trusted, so that equation 6 may follow it.
        learning_rate: Of both.
        order: Draws the minibatches of the policy gradient.
        q_order: Draws fresh suggestions, and the minibatches of equation 6.
    """
    loss, steps = 0.0, 0
    if distil and hyper.distil != "off":
        loss, steps = distil_policy(
            learned.policy,
            learned.adam["distil"],
            seen,
            _goal(seen, learned, hyper, q_order),
            steps=hyper.distil_steps,
            minibatch=hyper.distil_minibatch,
            kl_bound=hyper.distil_kl,
            learning_rate=learning_rate,
            max_grad_norm=hyper.max_grad_norm,
            generator=q_order,
        )
    advantage = _advantage(batch, seen, evidence, learned, hyper)
    normal = (batch.suggestion - collected.mean) * (-collected.log_std).exp()
    log_prob = log_density(normal, collected.log_std)
    weight = importance(log_prob, batch.log_prob, hyper.weight_limit)
    if hyper.kl_scope == "policy-gradient":
        collected = policy_now(learned, batch.obs)
    data = PolicyData(
        obs=seen,
        action=batch.suggestion,
        log_prob=log_prob,
        advantage=normalised(advantage, weight) if hyper.norm_advantage else advantage,
        weight=weight,
        mean=collected.mean,
        log_std=collected.log_std,
    )
    improvement = improve(
        learned.policy,
        learned.adam["policy"],
        data,
        hyper,
        learning_rate=learning_rate,
        generator=order,
    )
    spread = float(advantage.std(correction=0))
    return PolicyUpdate(improvement, loss, steps, spread)


@torch.no_grad()
def _goal(
    seen: Tensor, learned: Learned, hyper: OnPolicyConfig, generator: torch.Generator
) -> Tensor:
    return distil_target(
        learned.q_net,
        seen,
        learned.policy(seen),
        learned.policy.std(),
        suggestions=hyper.distil_suggestions,
        top=hyper.distil_top,
        action_mode=hyper.action_mode,
        generator=generator,
    )


@torch.no_grad()
def _advantage(
    batch: Batch, seen: Tensor, evidence: Evidence, learned: Learned, hyper: OnPolicyConfig
) -> Tensor:
    """What each executed suggestion is worth beyond the value of its state, in returns, ``[N]``."""
    if hyper.advantage != "q-v":
        return evidence.advantage
    q_value = learned.q_net(q_input(batch, seen, hyper))
    return (q_value - learned.value_net(seen)).squeeze(1) * learned.returns.std
