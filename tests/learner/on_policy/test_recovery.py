"""The recovery rule, against values worked out by hand."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.on_policy.recovery import Recovery, gap_as_printed, gap_invariant

RETURNS = st.floats(-1e6, 1e6, allow_nan=False)


def authors(bias: float = 0.65, offset: float = 0.0, cool_down: int = 0) -> Recovery:
    """Build the rule of equation 5."""
    return Recovery(
        rule="authors", bias=bias, statistic="max", episodes=0, offset=offset, cool_down=cool_down
    )


@pytest.mark.parametrize(
    ("r", "bias", "probability"),
    [
        (75.0, 0.0, 1 / 7),  # 25/175
        (75.0, 0.65, 0.0),
        (50.0, 0.0, 1 / 3),
        (30.0, 0.35, 70 / 130 - 0.35),
        (20.0, 0.65, 80 / 120 - 0.65),
        (0.0, 0.65, 0.35),
        (-50.0, 0.65, 0.35),  # the signs differ: the gap is 1
        (-50.0, 1.0, 0.0),  # alpha 1: never
    ],
)
def test_probability_is_the_gap_less_alpha(r: float, bias: float, probability: float) -> None:
    """Equation 5 as printed, at r* = 100."""
    rule = authors(bias)
    rule.judge([100.0], 0.0)
    assert rule.judge([r], 0.0).probability == pytest.approx(probability)


@pytest.mark.parametrize(("draw", "expected"), [(0.0, False), (0.64, False), (0.66, True)])
def test_recovers_when_the_draw_exceeds_alpha_plus_one_less_gap(
    draw: float, expected: bool
) -> None:
    """The test of equation 5, at alpha = .65 and gap = 1: the threshold is .65."""
    rule = authors()
    rule.judge([100.0], 0.99)
    assert rule.judge([-1.0], draw).recover is expected


@pytest.mark.parametrize(("offset", "probability"), [(0.0, 0.273), (100.0, 0.017)])
def test_offset_shifts_the_test_alone(offset: float, probability: float) -> None:
    """Of r = 20 and r* = 500, raw and with the authors' 100."""
    rule = authors(offset=offset)
    rule.judge([500.0], 0.0)
    assert rule.judge([20.0], 0.0).probability == pytest.approx(probability, abs=1e-3)


def test_max_takes_the_best_episode_and_mean_their_average() -> None:
    """A batch of cut segments has neither, and decides nothing."""
    mean = Recovery(rule="invariant", bias=0.65, statistic="mean", episodes=0)
    assert authors().judge([1.0, 5.0, 3.0], 0.0).r == 5.0
    assert mean.judge([1.0, 5.0, 3.0], 0.0).r == 3.0
    nothing = mean.judge([], 0.9)
    assert (nothing.r, nothing.recover, nothing.improved) == (None, False, False)


def test_window_is_undecided_until_it_is_full_and_after_recovery() -> None:
    """Failed episodes are forgotten."""
    rule = Recovery(rule="invariant", bias=0.0, statistic="mean", episodes=3)
    assert rule.judge([90.0, 100.0], 0.99).r is None
    assert rule.judge([110.0], 0.99).improved
    failed = rule.judge([0.0, 0.0, 0.0], 0.99)
    assert failed.recover
    assert (failed.r, failed.r_best) == (0.0, 100.0)
    assert rule.judge([0.0, 0.0], 0.99).r is None
    assert rule.judge([0.0], 0.99).recover


def test_cool_down_spares_the_updates_after_a_recovery() -> None:
    """Two updates, then the rule is back."""
    rule = authors(0.0, cool_down=2)
    rule.judge([100.0], 0.0)
    recovered = [rule.judge([-1.0], 0.5).recover for _ in range(7)]
    assert recovered == [True, False, False, True, False, False, True]


def test_invariant_gap_is_the_fraction_lost() -> None:
    """Of the best return, or of what was gained."""
    assert gap_invariant(70.0, 100.0, 0.0) == pytest.approx(0.3)
    assert gap_invariant(-150.0, -100.0, -300.0) == pytest.approx(0.25)  # 50 of 200 gained
    assert gap_invariant(-500.0, -100.0, -200.0) == 1.0
    assert gap_invariant(70e-12, 100e-12, 0.0) == pytest.approx(0.3)
    assert (gap_invariant(-1e-12, 0.0, 0.0), gap_invariant(0.0, 0.0, 0.0)) == (1.0, 0.0)


@given(r=RETURNS, best=RETURNS, first=RETURNS, scale=st.floats(1e-2, 1e2))
def test_invariant_gap_ignores_the_scale(r: float, best: float, first: float, scale: float) -> None:
    """Rewards in other units recover alike."""
    before = gap_invariant(r, best, first)
    after = gap_invariant(r * scale, best * scale, first * scale)
    if max(abs(best), best - first) > 1e-3:
        assert math.isclose(before, after, abs_tol=1e-6)


@given(r=RETURNS, best=RETURNS)
def test_gaps_are_fractions(r: float, best: float) -> None:
    """So that alpha means the same for both."""
    assert 0.0 <= gap_as_printed(r, best) <= 1.0 + 1e-12
    assert 0.0 <= gap_invariant(r, best, min(r, best)) <= 1.0


def test_state_through_json_goes_on_alike() -> None:
    """Window, r*, first return and cool-down survive."""
    one, other = (
        Recovery(rule="invariant", bias=0.1, statistic="mean", episodes=2, cool_down=1)
        for _ in range(2)
    )
    history = [(5.0, 0.1), (9.0, 0.9), (1.0, 0.95), (2.0, 0.99), (0.0, 0.999), (3.0, 0.5)]
    for r, draw in history[:3]:
        one.judge([r], draw)
    other.load(json.loads(json.dumps(one.state())))
    for r, draw in history[3:]:
        assert one.judge([r], draw) == other.judge([r], draw)
