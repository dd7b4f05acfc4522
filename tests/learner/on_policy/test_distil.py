"""Equation 6 as the presets `authors` and `paper` have it."""

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.gaussian import Policy
from a2s.learner.on_policy import state
from a2s.learner.on_policy.acting import ActionMode
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.distil import (
    distil_loss,
    distil_policy,
    distil_target,
)


class Nearest(Ensemble):
    """Values an action by how near it is to .3 in every dimension."""

    def score(self, obs: Tensor, action: Tensor) -> Tensor:
        """Score without looking at the observation."""
        return -(action - 0.3).square().sum(2)


def nearest() -> Nearest:
    """Build a critic of four observed numbers and two actions."""
    form = Form((6, 8, 1), activation="tanh", layer_norm=False)
    return Nearest(form, torch.zeros(form.length), single=True)


def make_policy() -> Policy:
    """Build a policy of four observed numbers and two actions."""
    return state.make_policy(4, 2, OnPolicyConfig(), torch.Generator().manual_seed(0))


def target_of(suggestions: int, action_mode: ActionMode = "clip") -> Tensor:
    """Distil for 500 observations."""
    return distil_target(
        nearest(),
        make_policy(),
        torch.zeros(500, 4),
        suggestions=suggestions,
        action_mode=action_mode,
        generator=torch.Generator().manual_seed(1),
    )


@pytest.mark.parametrize("action_mode", ["clip", "raw"])
def test_target_is_the_best_of_the_suggestions(action_mode: ActionMode) -> None:
    """The same noise drawn again gives the same candidates."""
    normal = torch.randn(500, 10, 2, generator=torch.Generator().manual_seed(1))
    policy = make_policy()
    with torch.no_grad():
        candidates = policy(torch.zeros(500, 4)).unsqueeze(1) + policy.std() * normal
    candidates = candidates.clamp(-1, 1) if action_mode == "clip" else candidates
    best = (candidates - 0.3).square().sum(2).argmin(1)
    assert torch.equal(target_of(10, action_mode), candidates[torch.arange(500), best])


def test_more_suggestions_come_nearer() -> None:
    """The target is an operator of improvement."""
    errors = [float((target_of(k) - 0.3).square().mean()) for k in (1, 4, 16, 64)]
    assert errors == sorted(errors, reverse=True)


def test_loss_by_hand() -> None:
    """And its gradient by the mean."""
    loss, grad_mean = distil_loss(torch.zeros(1, 2), torch.tensor([[1.0, 2.0]]))
    assert float(loss) == 2.5
    assert grad_mean.tolist() == [[-1.0, -2.0]]


@pytest.mark.parametrize(("bound", "all_steps"), [(0.02, False), (float("inf"), True)])
def test_steps_end_at_the_bound(bound: float, all_steps: bool) -> None:
    """Without one they would go all the way to the target; the deviation stays."""
    policy, obs = make_policy(), torch.randn(200, 4)
    before, log_std = policy(obs), policy.log_std.tolist()
    distilled = distil_policy(
        policy,
        Adam(policy.value),
        obs,
        torch.full((200, 2), 0.8),
        steps=50,
        minibatch=64,
        kl_bound=bound,
        learning_rate=1e-3,
        max_grad_norm=0.0,
        generator=torch.Generator().manual_seed(0),
    )
    moved = float((policy(obs) - before).square().sum(1).mean() / (2 * 0.25))
    assert (distilled.distil_steps == 50) is all_steps
    assert (moved < 0.05) is not all_steps
    assert moved > 0.01
    assert policy.log_std.tolist() == log_std
