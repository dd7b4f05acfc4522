"""Equation 6."""

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.on_policy.distil import (
    distil_loss,
    distil_policy,
    distil_target,
    score_in_parts,
)
from a2s.learner.on_policy.state import make_critic, make_policy
from a2s.learner.run.config import on_policy


class Nearest(Ensemble):
    """Values an action by how near it is to .3 in every dimension."""

    def score(self, obs: Tensor, action: Tensor) -> Tensor:
        """Score without looking at the observation."""
        return -(action - 0.3).square().sum(2)


def nearest() -> Nearest:
    """Build a critic of four observed numbers and two actions."""
    form = Form((6, 8, 1), activation="tanh", layer_norm=False)
    return Nearest(form, torch.zeros(form.length), single=True)


def target_of(suggestions: int, top: int, rows: int = 500) -> Tensor:
    """Distil from a policy with mean -.5 and standard deviation .5."""
    return distil_target(
        nearest(),
        torch.zeros(rows, 4),
        torch.full((rows, 2), -0.5),
        torch.full((2,), 0.5),
        suggestions=suggestions,
        top=top,
        action_mode="clip",
        generator=torch.Generator().manual_seed(1),
    )


def test_target_is_the_best_of_the_suggestions() -> None:
    """The same noise drawn again gives the same candidates."""
    normal = torch.randn(500, 10, 2, generator=torch.Generator().manual_seed(1))
    candidates = (-0.5 + 0.5 * normal).clamp(-1, 1)
    best = (candidates - 0.3).square().sum(2).argmin(1)
    assert torch.equal(target_of(10, 1), candidates[torch.arange(500), best])


def test_target_of_all_of_them_is_their_mean() -> None:
    """The other end of ``top``."""
    normal = torch.randn(500, 10, 2, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(target_of(10, 10), (-0.5 + 0.5 * normal).clamp(-1, 1).mean(1))


def test_more_suggestions_come_nearer() -> None:
    """The target is an operator of improvement."""
    errors = [float((target_of(k, 1) - 0.3).square().mean()) for k in (1, 4, 16, 64)]
    assert errors == sorted(errors, reverse=True)


def test_scores_in_parts_are_scores() -> None:
    """Neither 777 x 7 nor its parts are a multiple of the size of a part."""
    generator = torch.Generator().manual_seed(0)
    q_net = make_critic(6, (128, 64), on_policy("modern", "a2s", {}), generator)
    obs, action = torch.randn(777, 4), torch.randn(777, 7, 2)
    torch.testing.assert_close(score_in_parts(q_net, obs, action), q_net.score(obs, action))


def test_loss_by_hand() -> None:
    """And its gradient by the mean."""
    loss, pull = distil_loss(torch.zeros(1, 2), torch.tensor([[1.0, 2.0]]))
    assert float(loss) == 2.5
    assert pull.tolist() == [[-1.0, -2.0]]


def test_average_of_the_best_has_the_gradient_of_all_of_them() -> None:
    """So one target a step is enough."""
    best = torch.randn(6, 3, 2)
    gradients: list[Tensor] = []
    for goals in (best.unbind(1), [best.mean(1)]):
        mean = torch.zeros(6, 2)
        pulls = [distil_loss(mean, goal)[1] for goal in goals]
        gradients.append(torch.stack(pulls).mean(0))
    torch.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize(("bound", "all_steps"), [(0.02, False), (float("inf"), True)])
def test_separate_steps_end_at_the_bound(bound: float, all_steps: bool) -> None:
    """Without one they would go all the way to the target."""
    policy = make_policy(4, 2, on_policy("modern", "a2s", {}), torch.Generator().manual_seed(0))
    obs = torch.randn(200, 4)
    before = policy(obs)
    _, made = distil_policy(
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
    assert (made == 50) is all_steps
    assert (moved < 0.05) is not all_steps
    assert moved > 0.01
