"""Acting off-policy."""

import math
from typing import Any

import pytest
import torch

from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run.config import off_policy

LOW, HIGH = torch.tensor([-0.4, 1.0]), torch.tensor([0.4, 5.0])


def make(*, warms_up: bool = False, **options: Any) -> OffPolicySuggester:
    """Build a suggester with asymmetric bounds and critics that disagree."""
    small = {"critic_sizes": "16,8", "policy_sizes": "8,8", "act_suggestions": 6}
    hyper = off_policy("modern", {**small, "precision": "f32", **options})
    algorithm = OffPolicy(3, 2, hyper, 0)
    algorithm.train_state.critics.value.mul_(3.0)
    algorithm.observe(2.0 * torch.randn(50, 3, generator=torch.Generator().manual_seed(1)))
    return algorithm.suggester(LOW, HIGH, warms_up=warms_up)


def noise(rows: int, k: int = 6) -> torch.Tensor:
    """The same every time."""
    return torch.randn(rows, k, 2, generator=torch.Generator().manual_seed(2))


def test_choice_has_the_largest_mean_of_the_critics() -> None:
    """A loop over critics and suggestions."""
    suggester = make()
    obs, normal = torch.randn(12, 3), noise(12)
    choice = suggester(obs, normal)
    seen = suggester.normaliser(obs)
    mean, log_std = suggester.policy(seen)[0].chunk(2, 1)
    for row in range(12):
        candidates = (mean[row] + log_std[row].exp() * normal[row]).tanh()
        scores = []
        for candidate in candidates:
            joined = torch.cat([seen[row], candidate])
            one, other = suggester.critics(joined[None])[:, 0].mean(1)
            scores.append(float((one + other) / 2))
        best = scores.index(max(scores))
        torch.testing.assert_close(choice.suggestion[row], candidates[best])
        spread = max(scores) - sum(scores) / 6
        assert float(choice.q_spread[row]) == pytest.approx(spread, abs=1e-4)


def test_scores_and_temperature_are_in_returns() -> None:
    """Critics and temperature learned in units of 5: the same choices, five times the spread."""
    small, large = make(selection="soft"), make(selection="soft")
    large.return_size, large.temperature = torch.tensor(5.0), 5.0 * large.temperature
    gumbel = torch.randn(40, 6, generator=torch.Generator().manual_seed(5))
    obs, normal = torch.randn(40, 3), noise(40)
    one, other = small(obs, normal, gumbel), large(obs, normal, gumbel)
    assert torch.equal(one.suggestion, other.suggestion)
    torch.testing.assert_close(5.0 * one.q_spread, other.q_spread)


def test_soft_choice_is_a_draw_from_the_boltzmann_distribution_of_q() -> None:
    """Of many suggestions, by a histogram of the first of two dimensions against a fine grid."""
    k, rows = 150, 10_000
    suggester = make(act_suggestions=k, selection="soft", initial_temperature=0.5)
    suggester.policy.value.mul_(0.3)
    obs = torch.full((1, 3), 0.3)
    draw = torch.Generator().manual_seed(3)
    found = []
    for _ in range(10):
        normal = torch.randn(rows // 10, k, 2, generator=draw)
        gumbel = -torch.empty(rows // 10, k).exponential_(generator=draw).log()
        found.append(suggester(obs.expand(rows // 10, -1), normal, gumbel).suggestion)
    counts = torch.histc(torch.cat(found)[:, 0], 20, -1.0, 1.0) / rows
    grid = (torch.arange(200) + 0.5) / 100 - 1
    every = torch.cartesian_prod(grid, grid)
    score = suggester.score(suggester.normaliser(obs), every[None])[0]
    expected = (score.double() / 0.5).softmax(0).view(20, -1).sum(1).float()
    assert float(expected.max() / expected.min()) > 3.0  # else a uniform draw would pass as well
    torch.testing.assert_close(counts, expected, atol=0.012, rtol=0.0)


def test_soft_choice_without_noise_has_the_largest_score() -> None:
    obs, normal = torch.randn(50, 3), noise(50)
    hard, soft = make(selection="hard"), make(selection="soft")
    wanted = hard(obs, normal).suggestion
    assert torch.equal(soft(obs, normal).suggestion, wanted)
    assert torch.equal(soft(obs, normal, torch.zeros(50, 6)).suggestion, wanted)
    gumbel = -torch.empty(50, 6).exponential_().log()
    assert not torch.equal(soft(obs, normal, gumbel).suggestion, wanted)


def test_soft_log_prob_tells_the_chance_of_the_draw() -> None:
    """The policy's density times K times the chance, which a count over many draws finds."""
    suggester = make(selection="soft", initial_temperature=0.5)
    obs, normal = torch.randn(1, 3), noise(1)
    gumbel = -torch.empty(40_000, 6).exponential_().log()
    drawn = suggester(obs.expand(40_000, -1), normal.expand(40_000, -1, -1), gumbel)
    one = make(act_suggestions=1)
    for number in range(6):
        plain = one(obs, normal[:, number : number + 1])
        mine = (drawn.suggestion - plain.suggestion).abs().amax(1) < 1e-6
        chance = (drawn.log_prob - plain.log_prob).exp()[mine] / 6
        if len(chance) > 100:
            assert float(chance[0]) == pytest.approx(float(mine.float().mean()), abs=0.01)


@pytest.mark.parametrize("k", [1, 6])
def test_log_prob_is_that_of_the_action_under_the_policy(k: int) -> None:
    """By the change of variables, in double precision, where tanh loses little of u."""
    suggester = make(act_suggestions=k, selection="hard")
    suggester.policy.value.mul_(0.5)
    obs = torch.randn(9, 3, generator=torch.Generator().manual_seed(5))
    choice = suggester(obs, noise(9, k))
    mean, log_std = suggester.policy(suggester.normaliser(obs))[0].double().chunk(2, 1)
    u = choice.suggestion.double().atanh()
    gaussian = torch.distributions.Normal(mean, log_std.exp())
    density = gaussian.log_prob(u)  # type: ignore[no-untyped-call]
    expected = (density - (1 - choice.suggestion.double().square()).log()).sum(1)
    torch.testing.assert_close(choice.log_prob.double(), expected, rtol=1e-3, atol=1e-3)


def test_zero_noise_is_the_mean_action() -> None:
    """For any number of suggestions."""
    suggester, obs = make(), torch.randn(9, 3)
    choice = suggester(obs, torch.zeros(9, 6, 2))
    mean = suggester.policy(suggester.normaliser(obs))[0].chunk(2, 1)[0].tanh()
    torch.testing.assert_close(choice.suggestion, mean)
    torch.testing.assert_close(choice.q_spread, torch.zeros(9), atol=1e-5, rtol=0.0)


def test_one_suggestion_is_not_judged() -> None:
    """The mode ``first``."""
    suggester = make(act_suggestions=1)
    assert (suggester.mode, suggester.suggestions) == ("first", 1)
    assert suggester(torch.randn(4, 3), noise(4, 1)).q_spread.tolist() == [0.0] * 4


def test_warm_up_spreads_actions_evenly_over_the_bounds() -> None:
    """Tenths of the range hold a tenth each, whatever is observed."""
    suggester = make(warms_up=True)
    choice = suggester(torch.full((50_000, 3), 1e9), noise(50_000, 1))
    for dimension in range(2):
        low, high = float(LOW[dimension]), float(HIGH[dimension])
        counts = torch.histc(choice.action[:, dimension], 10, low, high) / 50_000
        torch.testing.assert_close(counts, torch.full((10,), 0.1), atol=0.006, rtol=0.0)
    assert choice.log_prob.tolist()[:2] == pytest.approx([-2 * math.log(2)] * 2)
    assert suggester(torch.zeros(1, 3), torch.zeros(1, 1, 2)).suggestion.tolist() == [[0.0, 0.0]]


def test_several_suggestions_need_critics() -> None:
    """They could only be picked by chance."""
    suggester = make()
    with pytest.raises(ValueError, match="mode first, K 3: expected K 1 without critics"):
        OffPolicySuggester(
            normaliser=suggester.normaliser,
            policy=suggester.policy,
            critics=suggester.critics,
            action_low=LOW,
            action_high=HIGH,
            mode="first",
            suggestions=3,
            temperature=torch.tensor(0.1),
            return_size=torch.tensor(1.0),
        )
