"""Gradients of the off-policy policy, against autograd and by hand."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from a2s.learner.networks.gaussian import log_density
from a2s.learner.off_policy.policy import advantage_over_others, pathwise, score
from a2s.learner.off_policy.squashed import Gaussian, draw, gaussian


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=8))
def test_advantage_over_others_is_against_the_mean_of_the_rest(values: list[float]) -> None:
    """By definition."""
    found = advantage_over_others(torch.tensor([values]))[0].tolist()
    for k, value in enumerate(values):
        rest = values[:k] + values[k + 1 :]
        assert found[k] == pytest.approx(value - sum(rest) / len(rest), abs=1e-3)


def worth(action: Tensor) -> Tensor:
    """A value of actions, ``[..., 2]``."""
    return (action[..., 0] - 2.0 * action[..., 1]) - action.square().sum(-1)


def output(rows: int = 6) -> Tensor:
    """What a policy network might say; some deviations out of range."""
    drawn = torch.randn(rows, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    drawn[0, 2], drawn[1, 3] = 5.0, -30.0
    return drawn.requires_grad_()


def test_pathwise_gradient_is_that_of_autograd() -> None:
    """Of temperature * log pi - Q, through the drawn action."""
    raw, normal = output(), torch.randn(6, 2).double()
    policy = gaussian(raw)
    u = policy.mean + policy.log_std.exp() * normal
    loss = (0.3 * log_density(normal, policy.log_std, u) - worth(u.tanh())).mean()
    torch.autograd.backward(loss)
    action = u.detach().tanh().requires_grad_()
    torch.autograd.backward(worth(action).sum())
    assert action.grad is not None
    free = Gaussian(*(each.detach() for each in policy))
    found = pathwise(
        free,
        draw(free, normal),
        worth(action).detach(),
        action.grad,
        torch.tensor(0.3, dtype=torch.float64),
    )
    assert raw.grad is not None
    torch.testing.assert_close(found.loss, loss.detach())
    torch.testing.assert_close(found.grad, raw.grad, rtol=1e-6, atol=1e-9)
    assert found.grad[0, 2] == found.grad[1, 3] == 0.0


def test_score_gradient_is_that_of_autograd() -> None:
    """Of -mean_k log pi(u_k) A_k, A_k and u_k taken as given."""
    raw, normal = output(), torch.randn(6, 5, 2).double()
    policy = gaussian(raw)
    mean, log_std = policy.mean.unsqueeze(1), policy.log_std.unsqueeze(1)
    u = (mean + log_std.exp() * normal).detach()
    density = torch.distributions.Normal(mean, log_std.exp())
    log_prob = density.log_prob(u).sum(2)  # type: ignore[no-untyped-call]
    soft = worth(u.tanh()) - 0.3 * log_density(normal, log_std, u).detach()
    others = (soft.sum(1, keepdim=True) - soft) / 4
    torch.autograd.backward(-(log_prob * (soft - others)).mean())
    free = Gaussian(*(each.detach() for each in policy))
    found = score(free, normal, worth(u.tanh()), torch.tensor(0.3, dtype=torch.float64))
    assert raw.grad is not None
    torch.testing.assert_close(found.grad, raw.grad, rtol=1e-6, atol=1e-9)


def test_score_and_pathwise_agree_on_average() -> None:
    """Two estimates of one gradient, without and with the entropy."""
    rows = 40_000
    raw = torch.tensor([[0.3, -0.2, -0.5, -1.0]]).expand(rows, 4)
    policy, normal = gaussian(raw), torch.randn(rows, 4, 2)
    action = (policy.mean + policy.log_std.exp() * normal[:, 0]).tanh().requires_grad_()
    torch.autograd.backward(worth(action).sum())
    assert action.grad is not None
    several = (policy.mean[:, None] + policy.log_std.exp()[:, None] * normal).tanh()
    for temperature in (torch.tensor(0.0), torch.tensor(0.5)):
        drawn = draw(policy, normal[:, 0])
        by_path = pathwise(policy, drawn, worth(action).detach(), action.grad, temperature)
        by_score = score(policy, normal, worth(several), temperature)
        one, other = by_path.grad.sum(0), by_score.grad.sum(0)
        torch.testing.assert_close(one, other, rtol=0.05, atol=0.03)
