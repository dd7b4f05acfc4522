"""Advantages and losses of the policy gradient."""

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import Policy, log_density
from a2s.learner.on_policy.policy_gradient import (
    PolicyData,
    differentiate,
    entropy,
    importance,
    improve,
    normalised,
    policy_loss,
)
from a2s.learner.on_policy.state import make_policy
from a2s.learner.on_policy.suggestion import log_preference, select_soft, take
from a2s.learner.run.config import on_policy


def density_of(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Log density of actions, ``[N]``."""
    return log_density((action - mean) * (-log_std).exp(), log_std)


def test_entropy_agrees_with_the_textbook() -> None:
    log_std = torch.randn(3)
    textbook = Independent(Normal(torch.zeros(5, 3), log_std.exp()), 1)
    torch.testing.assert_close(entropy(log_std), textbook.entropy()[0])  # type: ignore[no-untyped-call]


def test_score_loss_by_hand() -> None:
    """Equation 4."""
    log_prob, advantage = torch.tensor([-1.0, -3.0]), torch.tensor([2.0, -1.0])
    loss, slope = policy_loss("score", log_prob, torch.zeros(2), advantage, torch.ones(2), 0.2)
    assert float(loss) == -0.5  # -(-2 + 3) / 2
    assert slope.tolist() == [-1.0, 0.5]


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        (1.0, 2.0, -2.0, -2.0),
        (1.5, 2.0, -2.4, 0.0),  # gains end at 1.2
        (0.5, 2.0, -1.0, -1.0),
        (0.5, -2.0, 1.6, 0.0),  # losses end at 0.8
        (1.5, -2.0, 3.0, 3.0),
    ],
)
def test_clip_loss_by_hand(ratio: float, advantage: float, loss: float, slope: float) -> None:
    """Only gains are limited."""
    log_prob = torch.tensor([ratio]).log()
    worth = torch.tensor([advantage])
    for weight in (1.0, 3.0):
        found, steepness = policy_loss(
            "clip", log_prob, torch.zeros(1), worth, torch.full((1,), weight), 0.2
        )
        assert float(found) == pytest.approx(weight * loss)
        assert float(steepness) == pytest.approx(weight * slope)


def test_normalised_advantage_has_mean_0_and_deviation_1() -> None:
    """Whatever the scale of rewards; a weight of 2 counts a step twice."""
    advantage = torch.randn(100) * 7 + 3
    found = normalised(advantage, torch.ones(100))
    assert float(found.mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(found.std(correction=0)) == pytest.approx(1.0, rel=1e-5)
    twice = torch.cat([torch.full((50,), 4 / 3), torch.full((50,), 2 / 3)])
    written_out = normalised(torch.cat([advantage[:50], advantage]), torch.ones(150))
    torch.testing.assert_close(normalised(advantage, twice), written_out[50:])


def test_advantages_of_any_unit_are_normalised_alike_and_equal_ones_are_0() -> None:
    """Of equal ones a tenth is no float, so that their mean is not quite what they are."""
    advantage, weight = torch.randn(100), torch.rand(100) + 0.5
    expected = normalised(advantage, weight)
    for unit in (2.0**-60, 2.0**-30, 2.0**40):
        torch.testing.assert_close(normalised(unit * advantage, weight), expected)
    for same in (0.0, 0.1):
        found = normalised(torch.full((100,), same), torch.ones(100))
        torch.testing.assert_close(found, torch.zeros(100))


def test_weights_undo_the_selection_up_to_their_limit() -> None:
    """They have mean 1; without selection, or without a limit, they are 1."""
    drawn = torch.tensor([-1.0, -2.0, -3.0])
    picked = drawn + torch.tensor([4.0, 0.5, 0.25]).log()
    torch.testing.assert_close(
        importance(drawn, picked, 3.0), torch.tensor([0.25, 2.0, 3.0]) / 1.75
    )
    assert torch.equal(importance(drawn, drawn, 3.0), torch.ones(3))
    assert torch.equal(importance(drawn, picked, 0.0), torch.ones(3))


@pytest.mark.parametrize("weighed", [True, False])
def test_weights_make_the_gradient_that_of_the_policy(weighed: bool) -> None:
    """Q is wrong: it prefers large actions, all are worth the same 1; d E[1] / d mean = 0."""
    generator = torch.Generator().manual_seed(0)
    mean, log_std = torch.zeros(40_000, 1, requires_grad=True), torch.full((1,), 0.5).log()
    candidate = 0.5 * torch.randn(40_000, 10, 1, generator=generator)
    uniform = torch.rand(40_000, 10, generator=generator)
    index = select_soft(candidate[..., 0], -(-uniform.log()).log(), 1.0)
    action = take(candidate, index)
    log_prob = density_of(mean, log_std, action)
    executed = log_prob.detach() + log_preference(candidate[..., 0], index, 1.0)
    weight = importance(log_prob.detach(), executed, 50.0 if weighed else 0.0)
    drawn = log_prob.detach()
    _, slope = policy_loss("clip", drawn, drawn, torch.ones(40_000), weight, 0.2)
    (gradient,) = torch.autograd.grad(log_prob, mean, slope)
    if weighed:
        assert float(-gradient.sum()) == pytest.approx(0.0, abs=0.1)
    else:
        assert float(-gradient.sum()) > 1.0


def data_of(policy: Policy, rows: int = 400) -> PolicyData:
    """Suggestions that are the better the larger their first dimension is."""
    obs = torch.randn(rows, 4)
    mean = policy(obs)
    action = mean + policy.std() * torch.randn(rows, 2)
    return PolicyData(
        obs=obs,
        action=action,
        log_prob=density_of(mean, policy.log_std, action),
        advantage=normalised(action[..., 0], torch.ones(rows)),
        weight=torch.ones(rows),
        mean=mean,
        log_std=policy.log_std.clone(),
    )


@pytest.mark.parametrize("loss", ["score", "clip"])
def test_gradient_is_that_of_autograd(loss: str) -> None:
    """Of both losses and the entropy, written out once more from their definitions."""
    hyper = on_policy("modern", "a2s", {"policy_loss": loss, "entropy_weight": 0.1})
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(50, 2, generator=generator, requires_grad=True)
    log_std = torch.tensor([-0.5, -1.0], requires_grad=True)
    action = mean.detach() + torch.randn(50, 2, generator=generator) * 0.5
    log_prob = density_of(mean, log_std, action)
    part = PolicyData(
        obs=torch.zeros(50, 1),
        action=action,
        log_prob=log_prob.detach() + 0.3 * torch.randn(50, generator=generator),
        advantage=torch.randn(50, generator=generator),
        weight=torch.rand(50, generator=generator),
        mean=mean.detach(),
        log_std=log_std.detach(),
    )
    ratio = (log_prob - part.log_prob).exp()
    gain = torch.minimum(ratio * part.advantage, ratio.clamp(0.8, 1.2) * part.advantage)
    gain = gain if loss == "clip" else log_prob * part.advantage
    expected = -(part.weight * gain).mean()
    torch.autograd.backward(expected - 0.1 * entropy(log_std))
    found, by_mean, by_log_std = differentiate(mean.detach(), log_std.detach(), part, hyper)
    torch.testing.assert_close(found, expected.detach())
    torch.testing.assert_close(by_mean, mean.grad)
    torch.testing.assert_close(by_log_std, log_std.grad)


@pytest.mark.parametrize("loss", ["score", "clip"])
def test_policy_moves_to_what_was_better(loss: str) -> None:
    """The sign of either loss."""
    hyper = on_policy("modern", "a2s", {"policy_loss": loss, "learning_rate": 1e-3})
    policy = make_policy(4, 2, hyper, torch.Generator().manual_seed(0))
    data = data_of(policy)
    adam, generator = Adam(policy.value), torch.Generator().manual_seed(0)
    found = improve(policy, adam, data, hyper, learning_rate=1e-3, generator=generator)
    moved = (policy(data.obs) - data.mean).mean(0)
    assert float(moved[0]) > 0.01
    assert found.kl > 0.0


def test_passes_end_once_the_policy_has_moved_far_enough() -> None:
    """A pass is finished, then no other begins."""
    hyper = on_policy("modern", "a2s", {"kl_stop": 0.005})
    policy = make_policy(4, 2, hyper, torch.Generator().manual_seed(0))
    adam, generator = Adam(policy.value), torch.Generator().manual_seed(0)
    data = data_of(policy)
    found = improve(policy, adam, data, hyper, learning_rate=3e-3, generator=generator)
    assert found.epochs < hyper.policy_epochs
    assert found.kl > hyper.kl_stop


def test_std_is_held_at_its_floor() -> None:
    """Though the advantage asks for less."""
    hyper = on_policy("modern", "a2s", {"std": 0.5, "std_floor": 0.499})
    policy = make_policy(4, 2, hyper, torch.Generator().manual_seed(0))
    data = data_of(policy)
    narrow = -(data.action - data.mean).square().sum(1)
    adam, generator = Adam(policy.value), torch.Generator().manual_seed(0)
    narrower = PolicyData(
        obs=data.obs,
        action=data.action,
        log_prob=data.log_prob,
        advantage=normalised(narrow, data.weight),
        weight=data.weight,
        mean=data.mean,
        log_std=data.log_std,
    )
    improve(policy, adam, narrower, hyper, learning_rate=1e-2, generator=generator)
    torch.testing.assert_close(policy.std(), torch.full((2,), 0.499))
