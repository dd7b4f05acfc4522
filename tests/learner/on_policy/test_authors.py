"""What the presets authors and paper do otherwise."""

import pytest
import torch
from on_policy_learners import A, D, crash, fingerprint, make_preset, play

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy.authors import fit, score_step
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.critics import Regression
from a2s.learner.on_policy.state import make_critic, make_policy


def test_authors_recovery_restores_the_networks_and_still_learns() -> None:
    """Their equation 6 and gradient follow, with smaller steps; the wanted divergence falls."""
    algorithm = make_preset("authors", recovery_bias=0.0)
    best, stats = crash(algorithm)
    after = fingerprint(algorithm)
    assert after["q"] == best["q"]
    assert after["value"] == best["value"]
    assert after["adam.q.first"] != best["adam.q.first"]
    assert after["policy"] != best["policy"]
    assert (stats.q_fit_steps, stats.distil_steps, stats.policy_epochs) == (0, 50, 1)
    assert stats.kl_target == 1e-3 / 1.1


def test_authors_first_update_already_runs_at_half_as_much_again() -> None:
    """The divergence is 0 before anything was measured; a recovery divides by 5."""
    algorithm = make_preset("authors")
    stats = algorithm.update(play(algorithm, 0))
    assert stats.learning_rate == stats.critic_learning_rate == pytest.approx(1.5e-3)
    algorithm.recover(networks_only=True)
    assert algorithm.learning_rate.at(0.0) == pytest.approx(3e-4)


def test_score_step_is_one_step_up_equation_4() -> None:
    """Its gradient is that of autograd; the divergence is a mean over the dimensions."""
    policy, obs = (
        make_policy(D, A, AuthorsConfig(), torch.Generator().manual_seed(0)),
        torch.randn(50, D),
    )
    before, tape = policy.trace(obs)
    action, advantage = before + 0.5 * torch.randn(50, A), torch.randn(50)
    mean = before.clone().requires_grad_()
    normal = (action - mean) * (-policy.log_std).exp()
    expected = -(advantage * log_density(normal, policy.log_std)).mean()
    (mean_grad,) = torch.autograd.grad(expected, mean)
    policy.differentiate(tape, mean_grad, torch.zeros(A))
    wanted = policy.grad.clone()
    change = score_step(policy, Adam(policy.value), obs, action, advantage, 1e-3)
    torch.testing.assert_close(policy.grad, wanted)
    assert change.policy_loss == pytest.approx(float(expected.detach()))
    apart = (policy(obs) - before) / 0.5
    assert change.kl == pytest.approx(float(0.5 * apart.square().mean()), rel=1e-4)


@pytest.mark.parametrize(("size", "steps"), [(1.0, 101), (1e3, 130)])
def test_fit_stops_when_the_mean_loss_is_low(size: float, steps: int) -> None:
    """One step more than 100 where it is below 100, all of them where it never is."""
    generator, inputs = torch.Generator().manual_seed(0), torch.randn(96, D)
    net = make_critic(D, (64, 64), AuthorsConfig(), generator)
    job = Regression(net, Adam(net.value), inputs)
    _, made = fit(job, size * inputs.sum(1), 30, 1e-3, generator)
    assert made == steps
