"""What happens to the policy in an update: equation 6, then the policy gradient."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.algorithm.batch import Batch
from a2s.learner.algorithm.distil import distil_separately, distil_target, score_in_parts
from a2s.learner.algorithm.evidence import Evidence, q_input
from a2s.learner.algorithm.hyperparameters import OnPolicyHyper
from a2s.learner.algorithm.learned import Learned
from a2s.learner.algorithm.policy_gradient import (
    Improvement,
    PolicyData,
    advantage_over_others,
    importance,
    improve,
    log_density,
    normalised,
)
from a2s.learner.algorithm.suggestion import as_q_sees, suggest


class PolicyNow(NamedTuple):
    """A policy on a batch, kept: mean ``[N, A]`` and log standard deviation ``[A]``."""

    mean: Tensor
    log_std: Tensor


class PolicyUpdate(NamedTuple):
    """What equation 6 and the policy gradient did."""

    improvement: Improvement = Improvement(0.0, 0.0, 0, 0.0)
    distil_loss: float = 0.0
    distil_steps: int = 0
    advantage_std: float = 0.0


class _Weighed(NamedTuple):
    """Suggestions ``[N, J, A]``; log density, advantage in returns and weight, ``[N, J]`` each."""

    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    weight: Tensor


@torch.no_grad()
def policy_now(learned: Learned, obs: Tensor) -> PolicyNow:
    """Keep the present policy on a batch: observations as the environment gave them."""
    policy = learned.policy
    return PolicyNow(policy(learned.normaliser(obs)), policy.log_std.detach().clone())


def update_policy(
    batch: Batch,
    seen: Tensor,
    evidence: Evidence,
    collected: PolicyNow,
    learned: Learned,
    hyper: OnPolicyHyper,
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
    goal, loss, steps = None, 0.0, 0
    if distil and hyper.distil != "off":
        goal = _goal(seen, learned, hyper, q_order)
    if goal is not None and hyper.distil == "separate":
        loss, steps = distil_separately(
            learned.policy,
            learned.adam["distil"],
            seen,
            goal,
            kind=hyper.distil_loss,
            steps=hyper.distil_steps,
            minibatch=hyper.distil_minibatch,
            kl_bound=hyper.distil_kl,
            learning_rate=learning_rate,
            max_grad_norm=hyper.max_grad_norm,
            generator=q_order,
        )
        goal = None
    weighed = _weigh(batch, seen, evidence, collected, learned, hyper, q_order)
    advantage, weight = weighed.advantage, weighed.weight
    if hyper.kl_scope == "policy-gradient":
        collected = policy_now(learned, batch.obs)
    data = PolicyData(
        obs=seen,
        action=weighed.action,
        log_prob=weighed.log_prob,
        advantage=normalised(advantage, weight) if hyper.normalise_advantage else advantage,
        weight=weight,
        mean=collected.mean,
        log_std=collected.log_std,
        distil_target=goal,
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
    return PolicyUpdate(improvement, loss or improvement.distil_loss, steps, spread)


@torch.no_grad()
def _goal(
    seen: Tensor, learned: Learned, hyper: OnPolicyHyper, generator: torch.Generator
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
def _weigh(
    batch: Batch,
    seen: Tensor,
    evidence: Evidence,
    collected: PolicyNow,
    learned: Learned,
    hyper: OnPolicyHyper,
    generator: torch.Generator,
) -> _Weighed:
    """Find the suggestions that the gradient is about, and what each is worth."""
    if hyper.advantage == "all-suggestions":
        return _weigh_all(seen, learned, hyper, generator)
    advantage = evidence.advantage
    if hyper.advantage == "q-v":
        q_value = learned.q_net.combined(learned.q_net(q_input(batch, seen, hyper)))
        advantage = (q_value - learned.value_net(seen)) * learned.returns.std
    action = batch.suggestion.unsqueeze(1)
    log_prob = log_density(collected.mean, collected.log_std, action)
    weight = importance(log_prob, batch.log_prob.unsqueeze(1), hyper.weight_limit)
    return _Weighed(action, log_prob, advantage.unsqueeze(1), weight)


def _weigh_all(
    seen: Tensor, learned: Learned, hyper: OnPolicyHyper, generator: torch.Generator
) -> _Weighed:
    policy, count = learned.policy, max(hyper.suggestions, 2)
    mean, log_std = policy(seen), policy.log_std
    normal = torch.randn(len(seen), count, len(log_std), generator=generator)
    action = suggest(mean, policy.std(), normal)
    q_value = score_in_parts(learned.q_net, seen, as_q_sees(action, hyper.action_mode))
    advantage = advantage_over_others(q_value) * learned.returns.std
    log_prob = log_density(mean, log_std, action)
    return _Weighed(action, log_prob, advantage, torch.ones_like(advantage))
