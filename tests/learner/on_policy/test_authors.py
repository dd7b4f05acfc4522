"""What the presets authors and paper do otherwise."""

import pytest
import torch
from on_policy_learners import A, D, crash, fingerprint, make_preset, play

from a2s.learner.networks.adam import Adam, FlatParameters
from a2s.learner.networks.networks import Policy, Value
from a2s.learner.on_policy.authors import fit, score_step
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.critics import Regression
from a2s.learner.on_policy.policy import log_density


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
    policy = Policy(D, A, AuthorsConfig(), torch.Generator().manual_seed(0))
    parameters, obs = FlatParameters(policy), torch.randn(50, D)
    before = policy(obs)
    action, advantage = before.detach() + 0.5 * torch.randn(50, A), torch.randn(50)
    expected = -(advantage * log_density(before, policy.log_std, action)).mean()
    expected.backward()  # type: ignore[no-untyped-call]
    wanted = parameters.grad.clone()
    change = score_step(policy, Adam(parameters), obs, action, advantage, 1e-3)
    torch.testing.assert_close(parameters.grad, wanted)
    assert change.policy_loss == pytest.approx(float(expected.detach()))
    apart = (policy(obs) - before).detach() / 0.5
    assert change.kl == pytest.approx(float(0.5 * apart.square().mean()), rel=1e-4)


@pytest.mark.parametrize(("size", "steps"), [(1.0, 101), (1e3, 130)])
def test_fit_stops_when_the_mean_loss_is_low(size: float, steps: int) -> None:
    """One step more than 100 where it is below 100, all of them where it never is."""
    generator, inputs = torch.Generator().manual_seed(0), torch.randn(96, D)
    net = Value(D, AuthorsConfig(), generator)
    job = Regression(net.body, Adam(FlatParameters(net)), inputs)
    _, made = fit(job, size * inputs.sum(1), 30, 1e-3, generator)
    assert made == steps
