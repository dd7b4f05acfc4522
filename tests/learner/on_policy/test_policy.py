"""Densities, weights, losses and passes of the policy gradient."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import Policy, log_density
from a2s.learner.on_policy import state
from a2s.learner.on_policy.acting import log_preference, select_soft, take
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.fit_kernels import clipped_loss
from a2s.learner.on_policy.policy import (
    PolicyChange,
    PolicyData,
    entropy,
    gaussian_kl,
    importance,
    improve,
    normalised,
)


def density_of(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Log density of actions, ``[N]``."""
    return log_density((action - mean) * (-log_std).exp(), log_std)


def test_density_and_entropy_agree_with_the_textbook() -> None:
    """Against torch's distributions."""
    mean, log_std, action = torch.randn(5, 3), torch.randn(3), torch.randn(5, 3)
    textbook = Independent(Normal(mean, log_std.exp()), 1)
    torch.testing.assert_close(density_of(mean, log_std, action), textbook.log_prob(action))  # type: ignore[no-untyped-call]
    torch.testing.assert_close(entropy(log_std), textbook.entropy()[0])  # type: ignore[no-untyped-call]


def test_kl_agrees_with_the_textbook() -> None:
    """Against torch's distributions, by dimension."""
    mean, old_mean = torch.randn(2, 5, 3)
    log_std, old_log_std = torch.randn(2, 3)
    expected = kl_divergence(Normal(mean, log_std.exp()), Normal(old_mean, old_log_std.exp()))
    torch.testing.assert_close(gaussian_kl(mean, log_std, old_mean, old_log_std), expected)


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
    found = clipped_loss(math.log(ratio), 0.0, advantage, 0.2)
    assert found == pytest.approx((loss, slope))


def test_weights_undo_the_selection_up_to_their_limit() -> None:
    """They have mean 1; without selection, or without a limit, they are 1."""
    drawn = torch.tensor([-1.0, -2.0, -3.0])
    picked = drawn + torch.tensor([4.0, 0.5, 0.25]).log()
    torch.testing.assert_close(
        importance(drawn, picked, 3.0), torch.tensor([0.25, 2.0, 3.0]) / 1.75
    )
    assert torch.equal(importance(drawn, drawn, 3.0), torch.ones(3))
    assert torch.equal(importance(drawn, picked, 0.0), torch.ones(3))


def test_normalised_advantage_has_mean_0_and_deviation_1() -> None:
    """In any unit; a weight of 2 counts a step twice; equal ones are 0, though .1 is no float."""
    advantage, ones = torch.randn(100) * 7 + 3, torch.ones(100)
    found = normalised(advantage, ones)
    assert float(found.mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(found.std(correction=0)) == pytest.approx(1.0, rel=1e-5)
    twice = torch.cat([torch.full((50,), 4 / 3), torch.full((50,), 2 / 3)])
    written_out = normalised(torch.cat([advantage[:50], advantage]), torch.ones(150))
    torch.testing.assert_close(normalised(advantage, twice), written_out[50:])
    for unit in (2.0**-60, 2.0**-30, 2.0**40):
        torch.testing.assert_close(normalised(unit * advantage, ones), found)
    for same in (0.0, 0.1):
        torch.testing.assert_close(normalised(same * ones, ones), torch.zeros(100))


@pytest.mark.parametrize("weighed", [True, False])
def test_weights_make_the_gradient_that_of_the_policy(weighed: bool) -> None:
    """Q is wrong: it prefers large actions, all are worth the same 1; d E[1] / d mean = 0."""
    generator = torch.Generator().manual_seed(0)
    mean, log_std = torch.zeros(40_000, 1, requires_grad=True), torch.full((1,), 0.5).log()
    candidate = 0.5 * torch.randn(40_000, 10, 1, generator=generator)
    uniform = torch.rand(40_000, 10, generator=generator)
    index = select_soft(candidate[..., 0], -(-uniform.log()).log(), 2.0)
    action = take(candidate, index)
    log_prob = density_of(mean, log_std, action)
    executed = log_prob.detach() + log_preference(candidate[..., 0], index, 2.0)
    weight = importance(log_prob.detach(), executed, 50.0 if weighed else 0.0)
    (gradient,) = torch.autograd.grad(-(weight * log_prob).mean(), mean)
    if weighed:
        assert float(-gradient.sum()) == pytest.approx(0.0, abs=0.1)
    else:
        assert float(-gradient.sum()) > 1.0


def make_policy() -> Policy:
    """Build a policy of four observed numbers and two actions."""
    return state.make_policy(4, 2, OnPolicyConfig(), torch.Generator().manual_seed(0))


def data_of(policy: Policy, rows: int = 400) -> PolicyData:
    """Suggestions that are the better the larger their first dimension is."""
    obs = torch.randn(rows, 4)
    with torch.no_grad():
        mean = policy(obs)
    log_std = policy.log_std.detach().clone()
    action = mean + log_std.exp() * torch.randn(rows, 2)
    return PolicyData(
        obs=obs,
        action=action,
        log_prob=density_of(mean, log_std, action),
        advantage=normalised(action[..., 0], torch.ones(rows)),
        weight=torch.ones(rows),
        mean=mean,
        log_std=log_std,
    )


def improved(
    policy: Policy,
    data: PolicyData,
    learning_rate: float,
    kl_stop: float = 0.05,
    epochs: int = 10,
    minibatch: int = 256,
    pull: float = 0.0,
    std_floor: float = 0.15,
    max_grad_norm: float = 0.5,
    entropy_weight: float = 0.0,
) -> PolicyChange:
    """Improve with the rest as by default."""
    return improve(
        policy,
        Adam(policy.value),
        data,
        epochs=epochs,
        minibatch=minibatch,
        min_minibatches=8,
        kl_stop=kl_stop,
        clip_ratio=0.2,
        entropy_weight=entropy_weight,
        pull=pull,
        std_floor=std_floor,
        learning_rate=learning_rate,
        max_grad_norm=max_grad_norm,
        generator=torch.Generator().manual_seed(0),
    )


@pytest.mark.parametrize("moved", [True, False])
@pytest.mark.parametrize("pull", [0.0, 0.7])
def test_gradient_is_that_of_autograd(moved: bool, pull: float) -> None:
    """Of the clipped loss, the entropy and the pull; in the first step the former is A2C's loss."""
    torch.manual_seed(0)
    policy, data = make_policy(), data_of(make_policy(), 50)
    data = dataclasses.replace(
        data,
        log_prob=data.log_prob + moved * 0.3 * torch.randn(50),
        weight=torch.rand(50),
        wanted=data.mean + 0.3 * torch.randn(50, 2) if pull else None,
    )
    mean, tape = policy.trace(data.obs)
    mean, log_std = mean.clone().requires_grad_(), policy.log_std.clone().requires_grad_()
    log_prob = density_of(mean, log_std, data.action)
    ratio = (log_prob - data.log_prob).exp()
    clipped = torch.minimum(ratio * data.advantage, ratio.clamp(0.8, 1.2) * data.advantage)
    gain = clipped if moved else log_prob * data.advantage
    pulled = torch.zeros(())
    if data.wanted is not None:
        std = log_std.detach().exp()
        pulled = kl_divergence(Normal(data.wanted, std), Normal(mean, std)).sum(1).mean()
    loss = -(data.weight * gain).mean() - 0.1 * entropy(log_std) + pull * pulled
    loss.backward()  # type: ignore[no-untyped-call]
    assert mean.grad is not None
    assert log_std.grad is not None
    policy.differentiate(tape, mean.grad, log_std.grad)
    expected = policy.grad.clone()
    found = improved(
        policy, data, 1e-3, epochs=1, minibatch=0, pull=pull, kl_stop=1e9, max_grad_norm=0.0,
        entropy_weight=0.1,
    )  # fmt: skip
    torch.testing.assert_close(policy.grad, expected, rtol=1e-4, atol=1e-5)
    assert found.policy_loss == pytest.approx(
        -float((data.weight * clipped.detach()).mean()), abs=1e-5
    )
    assert found.distil_loss == pytest.approx(float(pulled.detach()), rel=1e-4)


@pytest.mark.parametrize(("epochs", "minibatch"), [(10, 256), (1, 0)])
def test_policy_moves_to_what_was_better(epochs: int, minibatch: int) -> None:
    """By PPO's passes, and by A2C's single step."""
    policy = make_policy()
    data = data_of(policy)
    found = improved(policy, data, 1e-3, epochs=epochs, minibatch=minibatch)
    with torch.no_grad():
        moved = (policy(data.obs) - data.mean).mean(0)
    assert float(moved[0]) > (0.01 if epochs > 1 else 1e-4)
    assert found.policy_epochs <= epochs
    assert found.kl > 0.0


def test_passes_end_once_the_policy_has_moved_far_enough() -> None:
    """A pass is finished, then no other begins."""
    policy = make_policy()
    found = improved(policy, data_of(policy), 3e-3, kl_stop=0.005)
    assert found.policy_epochs < 10
    assert found.kl > 0.005


@pytest.mark.parametrize("std_floor", [0.0, 0.15])
def test_a_smaller_std_is_lifted_to_its_floor(std_floor: float) -> None:
    """By the first step, in the parameter itself; 0 is none."""
    policy = make_policy()
    data = data_of(policy)
    policy.value[:2] = -9.0
    improved(policy, data, 0.0, epochs=1, std_floor=std_floor)
    expected = [math.log(std_floor)] * 2 if std_floor else [-9.0, -9.0]
    assert policy.log_std.tolist() == pytest.approx(expected)


def test_std_is_held_at_its_floor() -> None:
    """Though the advantage asks for less."""
    policy = make_policy()
    data = data_of(policy)
    narrow = -(data.action - data.mean).square().sum(1)
    improved(
        policy,
        dataclasses.replace(data, advantage=normalised(narrow, data.weight)),
        1e-2,
        std_floor=0.499,
    )
    torch.testing.assert_close(policy.std().detach(), torch.full((2,), 0.499))


@pytest.mark.parametrize("away", [0.0, 0.3])
def test_suggestions_pull_the_policy_to_what_they_want(away: float) -> None:
    """Where nothing was better they move it, or hold it where it is."""
    policy = make_policy()
    data = data_of(policy)
    asked = dataclasses.replace(
        data, advantage=torch.zeros(400), wanted=data.mean + away * data.log_std.exp()
    )
    found = improved(policy, asked, 3e-3, kl_stop=1.0, epochs=30, pull=1.0)
    with torch.no_grad():
        moved = ((policy(data.obs) - data.mean) / data.log_std.exp()).mean(0)
    torch.testing.assert_close(moved, torch.full((2,), away), atol=0.05, rtol=0.0)
    assert found.distil_steps == 240
    assert found.distil_loss < 0.01
    assert torch.equal(policy.log_std, data.log_std)
