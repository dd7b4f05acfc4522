"""Values as chances of a row of values."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.categorical import BINS, HALF_RANGE, WIDTH
from a2s.learner.on_policy.state import make_q


@given(target=st.floats(-HALF_RANGE + 2, HALF_RANGE - 2))
def test_chances_have_the_mean_of_the_target_and_their_width(target: float) -> None:
    """Far enough from the ends; the rounding to bins adds a twelfth of their width squared."""
    chance = categorical.spread(torch.tensor([target], dtype=torch.float64))[0].double()
    values = torch.linspace(-HALF_RANGE, HALF_RANGE, BINS, dtype=torch.float64)
    mean = float(chance @ values)
    variance = float(chance @ (values - mean).square())
    assert float(chance.sum()) == pytest.approx(1.0)
    assert mean == pytest.approx(target, abs=1e-3)
    assert variance == pytest.approx((0.75**2 + 1 / 12) * WIDTH**2, rel=0.01)


def test_a_target_beyond_the_range_is_its_end() -> None:
    """However far."""
    found = categorical.spread(torch.tensor([1e30, HALF_RANGE, -1e30, -HALF_RANGE]))
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[2], found[3])
    assert int(found[0].argmax()) == BINS - 1


def test_mean_of_logits_by_hand() -> None:
    """Two values that are equally likely, and all of them."""
    logits = torch.full((2, BINS), -1e9)
    logits[0, 0] = logits[0, 10] = 0.0
    logits[1] = 5.0
    expected = torch.tensor([-HALF_RANGE + 5 * WIDTH, 0.0])
    torch.testing.assert_close(categorical.mean(logits), expected, atol=1e-5, rtol=0.0)


def test_slope_is_that_of_autograd() -> None:
    """Of the cross-entropy, summed over the members."""
    logits = torch.randn(2, 9, BINS, requires_grad=True)
    chance = categorical.spread(torch.randn(9))
    expected = -(chance * logits.log_softmax(-1)).sum(-1).mean(1).sum()
    expected.backward()  # type: ignore[no-untyped-call]
    loss, slope = categorical.loss_and_slope(logits.detach(), chance)
    torch.testing.assert_close(loss, expected.detach())
    torch.testing.assert_close(slope, logits.grad)


def test_score_is_the_mean_of_both_critics() -> None:
    """One call for all K; each action for itself gives the same."""
    q_net = make_q(5, (16, 16), torch.Generator().manual_seed(0))
    obs, action = torch.randn(7, 3), torch.randn(7, 4, 2)
    found = categorical.score(q_net, obs, action)
    for k in range(4):
        logits = q_net(torch.cat([obs, action[:, k]], 1))
        torch.testing.assert_close(found[:, k], categorical.mean(logits).mean(0))
