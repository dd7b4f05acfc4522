"""Values as chances of a row of values."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.on_policy import categorical, fit_kernels
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


def test_cross_entropy_and_its_slope_are_those_of_autograd() -> None:
    """Mean over rows."""
    logits = (9.0 * torch.randn(9, BINS)).requires_grad_()
    chance = categorical.spread(torch.randn(9))
    expected = -(chance * logits.log_softmax(-1)).sum(-1).mean()
    expected.backward()  # type: ignore[no-untyped-call]
    slope = logits.detach().numpy().copy()
    found = fit_kernels.cross_entropy(slope, chance.numpy())
    assert found == pytest.approx(float(expected.detach()), rel=1e-5)
    torch.testing.assert_close(torch.from_numpy(slope), logits.grad)


@pytest.mark.parametrize(("states", "count"), [(7, 4), (700, 3), (2, 1000)])
def test_score_is_the_mean_of_both_critics(states: int, count: int) -> None:
    """One call for all K; each action for itself gives the same; more than fit in at once."""
    q_net = make_q(5, (16, 16), torch.Generator().manual_seed(0))
    q_net.value += 0.3 * torch.randn(len(q_net.value))
    obs, action = torch.randn(states, 3), torch.randn(states, count, 2)
    found = categorical.score(q_net, obs, action)
    joined = torch.cat([obs.unsqueeze(1).expand(-1, count, -1), action], 2).flatten(0, 1)
    values = torch.linspace(-HALF_RANGE, HALF_RANGE, BINS)
    expected = (q_net(joined).softmax(-1) @ values).mean(0).view(states, count)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
