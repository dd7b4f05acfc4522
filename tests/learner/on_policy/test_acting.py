"""Suggesting, picking, and acting as one module."""

import math

import pytest
import torch

from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.acting import (
    ActionMode,
    Suggester,
    SuggesterMode,
    as_q_sees,
    log_preference,
    select_hard,
    select_soft,
)
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.state import make_policy, make_q
from a2s.protocol.errors import A2SError

LOW, HIGH = torch.tensor([-0.4, 1.0]), torch.tensor([0.4, 5.0])


def make(mode: SuggesterMode, action_mode: ActionMode = "clip", k: int = 6) -> Suggester:
    """Build a suggester with asymmetric bounds."""
    generator = torch.Generator().manual_seed(0)
    policy = make_policy(3, 2, OnPolicyConfig(), generator)
    q_net = make_q(5, (16, 16), generator)
    return Suggester(
        normaliser=Normaliser(3, enabled=True),
        policy=policy,
        q_net=None if mode == "first" else q_net,
        action_low=LOW,
        action_high=HIGH,
        mode=mode,
        suggestions=k,
        action_mode=action_mode,
        q_scale=2.0,
    )


def test_q_sees_clipped_suggestions_in_clip_mode_only() -> None:
    """The environment executes the clipped one."""
    suggestion = torch.tensor([[1.5, -3.0, 0.2]])
    torch.testing.assert_close(as_q_sees(suggestion, "clip"), torch.tensor([[1.0, -1.0, 0.2]]))
    assert as_q_sees(suggestion, "raw") is suggestion


def test_among_equals_the_first_is_picked() -> None:
    """A tie must not depend on the machine."""
    q_value = torch.tensor([[1.0, 3.0, 3.0], [2.0, 2.0, 2.0], [0.0, 1.0, 5.0]])
    assert select_hard(q_value).tolist() == [1, 0, 2]
    assert select_soft(q_value, torch.zeros(3, 3), 1.0).tolist() == [1, 0, 2]
    gumbel = torch.tensor([[0.1, 2.0, 0.3]])  # a spread of 0 leaves it to the noise
    assert select_soft(torch.full((1, 3), 7.0), gumbel, 1.0).tolist() == [1]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_scores_that_are_not_finite_are_refused(bad: float) -> None:
    """An argmax over nan picks something silently."""
    q_value = torch.tensor([[1.0, bad]])
    with pytest.raises(A2SError, match="found 1 non-finite of 2, expected finite"):
        select_hard(q_value)
    with pytest.raises(A2SError, match="found 1 non-finite of 2, expected finite"):
        select_soft(q_value, torch.zeros(1, 2), 1.0)


@pytest.mark.parametrize("inverse_temperature", [0.0, 0.2, 1.0])
def test_soft_selection_draws_from_the_softmax(inverse_temperature: float) -> None:
    """Frequencies of 40000 draws; at 0 any of them."""
    generator = torch.Generator().manual_seed(0)
    q_value = torch.tensor([[3.0, 10.0, 4.0, -2.0]])
    rows = 40_000
    gumbel = -torch.log(-torch.log(torch.rand(rows, 4, generator=generator)))
    drawn = select_soft(q_value.expand(rows, 4), gumbel, inverse_temperature)
    expected = torch.softmax(inverse_temperature * q_value, 1)[0]
    frequency = torch.bincount(drawn, minlength=4) / rows
    torch.testing.assert_close(frequency, expected, atol=0.01, rtol=0.0)
    log_chance = log_preference(q_value, torch.tensor([1]), inverse_temperature)
    assert float(log_chance) == pytest.approx(float((4 * expected[1]).log()), abs=1e-5)


def test_canonical_interval_spans_the_bounds() -> None:
    """And what lies outside is clipped."""
    suggester = make("first", k=1)
    canonical = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0], [9.0, -9.0]])
    expected = torch.stack([LOW, HIGH, torch.tensor([0.0, 3.0]), torch.tensor([0.4, 1.0])])
    torch.testing.assert_close(suggester.bounds.to_env(canonical), expected)


@pytest.mark.parametrize("action_mode", ["clip", "raw"])
def test_hard_choice_is_the_candidate_of_largest_q(action_mode: ActionMode) -> None:
    """The loop over K of algorithm 1, written out."""
    suggester = make("hard", action_mode)
    obs, normal = torch.randn(12, 3), 3.0 * torch.randn(12, 6, 2)
    choice = suggester(obs, normal)
    norm_obs = suggester.normaliser(obs)
    candidates = suggester.policy(norm_obs).unsqueeze(1) + suggester.policy.std() * normal
    assert suggester.q_net is not None
    shown = candidates.clamp(-1, 1) if action_mode == "clip" else candidates
    q_value = categorical.score(suggester.q_net, norm_obs, shown)
    assert torch.equal(choice.suggestion, candidates[torch.arange(12), q_value.argmax(1)])
    spread = 2.0 * (q_value.amax(1) - q_value.mean(1))
    torch.testing.assert_close(choice.q_spread, spread)


def test_without_q_there_is_one_suggestion() -> None:
    """Several of them could only be picked by chance."""
    choice = make("first", k=1)(torch.randn(4, 3), torch.zeros(4, 1, 2))
    assert choice.q_spread.tolist() == [0.0] * 4
    with pytest.raises(ValueError, match="only mode 'first' has no Q"):
        make("first", k=3)
