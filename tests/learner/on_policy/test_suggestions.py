"""Equation 6 in general: what K suggestions want of the policy."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.on_policy.state import make_q
from a2s.learner.on_policy.suggestions import (
    Pull,
    inverse_temperature_at,
    pull_of_suggestions,
    share_that_counts,
)


class _Asked(NamedTuple):
    """An untrained Q, 400 states, and a policy in them."""

    q_net: Ensemble
    obs: Tensor  # [400, 3]
    mean: Tensor  # [400, 2]
    std: Tensor  # [2]


def asked() -> _Asked:
    """Draw the same every time."""
    generator = torch.Generator().manual_seed(0)
    mean, std = 0.1 * torch.randn(400, 2, generator=generator), torch.tensor([0.2, 0.3])
    q_net = make_q(5, (16, 16), generator)
    q_net.exact.weight[-1].mul_(100.0)  # else it says about the same of every action
    return _Asked(q_net, torch.randn(400, 3, generator=generator), mean, std)


def pull_of(
    factor: float, *, suggestions: int = 8, temperature: float = 0.1, least_share: float = 0.9
) -> tuple[Pull, Tensor, Tensor]:
    """Pull the policy of `asked`; also its means and deviations."""
    of = asked()
    found = pull_of_suggestions(
        *of,
        suggestions=suggestions,
        factor=factor,
        temperature=temperature,
        least_share=least_share,
        act_least_share=0.97,
        generator=torch.Generator().manual_seed(1),
    )
    return found, of.mean, of.std


def scores() -> tuple[Tensor, Tensor]:
    """What its Q says of the K that `pull_of` draws, ``[400, 8]``, and these."""
    q_net, obs, mean, std = asked()
    normal = torch.randn(400, 8, 2, generator=torch.Generator().manual_seed(1))
    action = mean.unsqueeze(1) + std * normal
    inputs = torch.cat([obs.unsqueeze(1).expand(-1, 8, -1), action.clamp(-1, 1)], 2)
    values = torch.linspace(-12, 12, 51)
    return (q_net(inputs.flatten(0, 1)).softmax(-1) @ values).mean(0).view(400, 8), action


def test_share_by_hand() -> None:
    """All alike: the whole; one of four that counts alone: a quarter."""
    assert share_that_counts(torch.zeros(3, 4), 1.0) == pytest.approx(1.0)
    alone = torch.tensor([[0.0, 0.0, 50.0, 0.0]])
    assert share_that_counts(alone, 1.0) == pytest.approx(0.25)
    both = torch.cat([alone, torch.zeros(1, 4)])
    assert share_that_counts(both, 1.0) == pytest.approx(0.625)
    assert share_that_counts(both, 0.0) == pytest.approx(1.0)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.97])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_so_much_of_the_suggestions_counts(share: float, unit: float) -> None:
    """Whatever the unit of the scores."""
    score = torch.randn(300, 10, generator=torch.Generator().manual_seed(0)) * unit
    found = inverse_temperature_at(score, share)
    assert share_that_counts(score, found) == pytest.approx(share, abs=1e-3)
    assert inverse_temperature_at(score, share, at_most=0.5 * found) == 0.5 * found
    assert inverse_temperature_at(score, share, at_most=2.0 * found) == found


def test_where_all_are_alike_there_is_nothing_to_want() -> None:
    """A score that is the same for all K, though not in all states."""
    assert inverse_temperature_at(torch.arange(6.0).unsqueeze(1).expand(6, 10), 0.9) == 0.0


def test_a_q_that_is_worth_nothing_has_no_strength() -> None:
    """Neither in the update nor in the actors."""
    found, _, _ = pull_of(0.0)
    assert (found.strength, found.act_inverse_temperature) == (0.0, 0.0)


def test_strength_is_what_a_q_that_is_right_would_want_by_what_it_may() -> None:
    """How far the mean is pulled is the same for all; above the most, strength is 1."""
    sure, mean, _ = pull_of(1e3)
    assert sure.strength == 1.0
    half, _, _ = pull_of(0.5 * 0.1 * sure.inverse_temperature, temperature=0.1)
    assert half.strength == pytest.approx(0.5)
    assert torch.equal(half.mean, sure.mean)
    assert not torch.equal(sure.mean, mean)


def test_a_weaker_pull_is_to_first_order_that_of_a_higher_temperature() -> None:
    """``strength`` times the way is the way at the temperature of a Q that is right."""
    factor = 0.01
    found, mean, _ = pull_of(factor, least_share=0.95)
    assert 0.2 < found.strength < 0.8
    score, action = scores()
    weight = (score * factor / 0.1).softmax(1)
    way = ((weight - 1 / 8).unsqueeze(2) * action).sum(1)
    way_found = found.strength * (found.mean - mean)
    assert float((way_found - way).norm() / way.norm()) < 0.2


def test_pull_is_the_weighted_mean_less_the_plain_one() -> None:
    """The same noise drawn again; both means are over the same K actions."""
    found, mean, _ = pull_of(1.0)
    score, action = scores()
    weight = (score * found.inverse_temperature).softmax(1)
    wanted = mean + (weight.unsqueeze(2) * action).sum(1) - action.mean(1)
    torch.testing.assert_close(found.mean, wanted, atol=1e-4, rtol=1e-4)


def test_more_of_the_suggestions_counts_for_actors() -> None:
    """However sure Q is; less, where it is not."""
    found, _, _ = pull_of(1e3, least_share=0.6)
    assert 0 < found.act_inverse_temperature < found.inverse_temperature
    assert pull_of(1e-4)[0].act_inverse_temperature == pytest.approx(1e-3)
