"""Equation 6 in general: what K suggestions want of the policy."""

import pytest
import torch
from torch import Tensor

from a2s.learner.on_policy.state import make_q
from a2s.learner.on_policy.suggestions import (
    Pull,
    limited_inverse_temperature,
    pull_of_suggestions,
    share_that_counts,
)


def pull_of(
    factor: float, *, suggestions: int = 8, temperature: float = 0.1, least_share: float = 0.0
) -> tuple[Pull, Tensor, Tensor]:
    """Ask an untrained Q in 400 states, with means ``[400, 2]`` and deviations ``[2]``."""
    generator = torch.Generator().manual_seed(0)
    mean, std = 0.1 * torch.randn(400, 2, generator=generator), torch.tensor([0.2, 0.3])
    q_net = make_q(5, (16, 16), generator)
    q_net.exact.weight[-1].mul_(100.0)  # else it says about the same of every action
    found = pull_of_suggestions(
        q_net,
        torch.randn(400, 3, generator=generator),
        mean,
        std,
        suggestions=suggestions,
        factor=factor,
        temperature=temperature,
        least_share=least_share,
        act_least_share=0.97,
        generator=torch.Generator().manual_seed(1),
    )
    return found, mean, std


def test_share_by_hand() -> None:
    """All alike: the whole; one of four that counts alone: a quarter."""
    assert share_that_counts(torch.zeros(3, 4), 1.0) == pytest.approx(1.0)
    alone = torch.tensor([[0.0, 0.0, 50.0, 0.0]])
    assert share_that_counts(alone, 1.0) == pytest.approx(0.25)
    both = torch.cat([alone, torch.zeros(1, 4)])
    assert share_that_counts(both, 1.0) == pytest.approx(0.625)
    assert share_that_counts(both, 0.0) == pytest.approx(1.0)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.97])
def test_temperature_is_raised_until_enough_counts(share: float) -> None:
    """And no further; where enough counts already it is the wanted one."""
    score = torch.randn(300, 10, generator=torch.Generator().manual_seed(0))
    found = limited_inverse_temperature(score, 100.0, share)
    assert share_that_counts(score, found) == pytest.approx(share, abs=1e-3)
    assert limited_inverse_temperature(score, 0.5 * found, share) == 0.5 * found


def test_a_q_that_is_worth_nothing_wants_the_policy_as_it_is() -> None:
    """To the last digit: the mean is not estimated from the K."""
    found, mean, _ = pull_of(0.0)
    assert torch.equal(found.mean, mean)
    assert (found.share, found.inverse_temperature, found.act_inverse_temperature) == (1.0, 0, 0)


def test_pull_is_the_weighted_mean_less_the_plain_one() -> None:
    """The same noise drawn again; both means are over the same K actions."""
    found, mean, std = pull_of(1.0)
    normal = torch.randn(400, 8, 2, generator=torch.Generator().manual_seed(1))
    action = mean.unsqueeze(1) + std * normal
    generator = torch.Generator().manual_seed(0)
    torch.randn(400, 2, generator=generator)
    q_net = make_q(5, (16, 16), generator)
    q_net.exact.weight[-1].mul_(100.0)
    obs = torch.randn(400, 3, generator=generator)
    inputs = torch.cat([obs.unsqueeze(1).expand(-1, 8, -1), action.clamp(-1, 1)], 2)
    values = torch.linspace(-12, 12, 51)
    score = (q_net(inputs.flatten(0, 1)).softmax(-1) @ values).mean(0).view(400, 8)
    weight = (score / 0.1).softmax(1)
    wanted = mean + (weight.unsqueeze(2) * action).sum(1) - action.mean(1)
    torch.testing.assert_close(found.mean, wanted, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("least", [0.6, 0.9])
def test_enough_of_the_suggestions_counts(least: float) -> None:
    """However sure Q is; more of them in what actors choose by."""
    found, _, _ = pull_of(1e3, least_share=least)
    assert found.share == pytest.approx(least, abs=1e-3)
    assert 0 < found.act_inverse_temperature < found.inverse_temperature
