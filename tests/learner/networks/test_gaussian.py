"""Gaussian policies against torch's distributions."""

import math

import torch

from a2s.learner.networks.acting import ActionBounds
from a2s.learner.networks.gaussian import Policy, log_density


def test_log_density_is_the_textbook_one() -> None:
    """Of a Gaussian, and of one through tanh, by the change of variables."""
    mean, log_std, normal = torch.randn(5, 3), torch.randn(5, 3), torch.randn(5, 3)
    u = mean + log_std.exp() * normal
    textbook = torch.distributions.Normal(mean, log_std.exp()).log_prob(u)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(log_density(normal, log_std), textbook.sum(1))
    slope = torch.log(1.0 - u.double().tanh().square()).float()
    found = log_density(normal, log_std, u)
    torch.testing.assert_close(found, (textbook - slope).sum(1), rtol=1e-4, atol=1e-4)


def test_squashed_log_density_is_finite_at_the_bounds() -> None:
    """By hand: far out the slope of tanh is 4 exp(-2 |u|)."""
    u = torch.tensor([[50.0], [-50.0]])
    found = log_density(torch.zeros(2, 1), torch.zeros(2, 1), u)
    wanted = -0.5 * math.log(2.0 * math.pi) - math.log(4.0) + 100.0
    torch.testing.assert_close(found, torch.full((2,), wanted))


def make(learns_std: bool) -> Policy:
    return Policy(
        (4, 8, 2),
        layer_norm=True,
        init="uniform",
        std=0.5,
        learns_std=learns_std,
        generator=torch.Generator().manual_seed(0),
    )


def test_std_is_a_parameter_only_when_learned() -> None:
    """It is the beginning of the policy's parameters."""
    fixed, learned = make(False), make(True)
    assert len(learned.value) == len(fixed.value) + 2
    torch.testing.assert_close(fixed.std(), torch.full((2,), 0.5))
    learned.value[:2] = -9.0
    assert learned.log_std.tolist() == [-9.0, -9.0]


def test_gradient_of_a_learned_std_is_beside_that_of_the_network() -> None:
    for policy in (make(False), make(True)):
        mean, tape = policy.trace(torch.randn(7, 4))
        policy.grad.fill_(float("nan"))
        policy.differentiate(tape, torch.ones_like(mean), torch.tensor([3.0, 4.0]))
        assert bool(policy.grad[:-6].isfinite().all())  # 74 parameters and 6 of padding
        assert (policy.grad[:2].tolist() == [3.0, 4.0]) == policy.learns_std


def test_canonical_actions_span_the_bounds() -> None:
    """-1 and 1 are the ends, to the bit; what is beyond is cut."""
    bounds = ActionBounds(torch.tensor([-0.4, 1.0]), torch.tensor([0.4, 5.0]))
    canonical = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0], [9.0, -9.0]])
    low, high, middle, beyond = bounds.to_env(canonical).tolist()
    assert [low, high] == [bounds.low.tolist(), bounds.high.tolist()]
    assert beyond == [high[0], low[1]]
    assert middle == [0.0, 3.0]
