"""Returns, advantages and targets, against the definition written out slowly."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from on_policy_learners import batch_of
from torch import Tensor

from a2s.learner.on_policy.returns import (
    ReturnScale,
    bootstrap,
    correlation,
    explained_variance,
    lambda_estimates,
    v_trace,
)

any_segments = given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=4),
    gamma=st.floats(0.5, 1.0),
    lam=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)


def _cut(lengths: list[int], *rows: Tensor) -> list[list[Tensor]]:
    ends = torch.tensor(lengths).cumsum(0).tolist()[:-1]
    return [list(each.tensor_split(ends)) for each in rows]


def slow_advantage(
    reward: list[float], value: list[float], after: float, gamma: float, lam: float
) -> list[float]:
    """One segment: the lambda-weighted average of all n-step advantages, by definition."""
    steps = len(reward)
    values = [*value, after]
    found = []
    for t in range(steps):
        n_step = [
            sum(gamma**i * reward[t + i] for i in range(n)) + gamma**n * values[t + n] - value[t]
            for n in range(1, steps - t + 1)
        ]
        weights = [(1 - lam) * lam**i for i in range(len(n_step) - 1)]
        weights.append(lam ** (len(n_step) - 1))
        found.append(sum(w * a for w, a in zip(weights, n_step, strict=True)))
    return found


@any_segments
@settings(deadline=None)
def test_estimates_agree_with_the_definition(
    lengths: list[int], gamma: float, lam: float, seed: int
) -> None:
    """Segments of random lengths, beside each other: nothing leaks from one into another."""
    generator = torch.Generator().manual_seed(seed)
    reward = torch.randn(sum(lengths), generator=generator)
    value = torch.randn(sum(lengths), generator=generator)
    after = torch.randn(len(lengths), generator=generator)
    batch = batch_of(reward, lengths, [False] * len(lengths))
    found = lambda_estimates(batch, value, after, gamma=gamma, lam=lam)
    expected: list[float] = []
    for r, v, a in zip(*_cut(lengths, reward, value), after, strict=True):
        expected += slow_advantage(r.tolist(), v.tolist(), float(a), gamma, lam)
    torch.testing.assert_close(found.advantage, torch.tensor(expected), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found.target, found.advantage + value)


@any_segments
@settings(deadline=None)
def test_v_trace_agrees_with_the_sum_of_its_paper(
    lengths: list[int], gamma: float, lam: float, seed: int
) -> None:
    """``v = V + sum_t gamma^t c_1..c_(t-1) rho_t delta_t``, ``c = lam rho``; Q's: r + gamma v."""
    generator = torch.Generator().manual_seed(seed)
    reward, value = torch.randn(2, sum(lengths), generator=generator)
    ratio = 2.0 * torch.rand(sum(lengths), generator=generator)
    after = torch.randn(len(lengths), generator=generator)
    batch = batch_of(reward, lengths, [False] * len(lengths))
    found = v_trace(batch, value, after, ratio, gamma=gamma, lam=lam)
    expected: list[float] = []
    for r, v, rho, a in zip(
        *_cut(lengths, reward, value, ratio.clamp(max=1.0)), after, strict=True
    ):
        following = torch.cat([v[1:], a.view(1)])
        delta = r + gamma * following - v
        for start in range(len(r)):
            total, trace = float(r[start] + gamma * following[start]), gamma * lam
            for t in range(start + 1, len(r)):
                total += trace * float(rho[t] * delta[t])
                trace *= gamma * lam * float(rho[t])
            expected.append(total)
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-4, rtol=1e-4)


def test_v_trace_of_the_policy_that_played_is_lambda_estimates() -> None:
    """Ratios of 1, and above."""
    reward, value = torch.randn(2, 7)
    after, batch = torch.randn(2), batch_of(reward, [3, 4], [False, False])
    expected = lambda_estimates(batch, value, after, gamma=0.9, lam=0.7).target
    for ratio in (1.0, 1.5):
        found = v_trace(batch, value, after, torch.full((7,), ratio), gamma=0.9, lam=0.7)
        torch.testing.assert_close(found, expected)


def test_target_of_lambda_one_is_the_discounted_return() -> None:
    """V cancels from it."""
    batch = batch_of(torch.tensor([1.0, 2.0, 4.0]), [3], [True])
    found = lambda_estimates(batch, torch.randn(3), torch.zeros(1), gamma=0.5, lam=1.0)
    torch.testing.assert_close(found.target, torch.tensor([3.0, 4.0, 4.0]))  # 1 + .5 (2 + .5 4)


def test_only_termination_ends_what_is_expected() -> None:
    """Terminated, truncated, cut; and the authors' way."""
    batch = batch_of(torch.zeros(3), [1, 1, 1], [True, False, False], False, True, False)
    final = torch.tensor([7.0, 8.0, 9.0])
    modern = bootstrap(batch, final, time_limit_is_terminal=False)
    authors = bootstrap(batch, final, time_limit_is_terminal=True)
    assert modern.tolist() == [0.0, 8.0, 9.0]
    assert authors.tolist() == [0.0, 0.0, 9.0]


def test_scale_of_returns_has_the_moments_of_all_targets() -> None:
    """Within the window."""
    scale = ReturnScale(enabled=True, window_steps=10_000)
    parts = [torch.randn(100) * 3 + 5, torch.randn(50) - 20, torch.randn(7)]
    for part in parts:
        scale.update(part)
    everything = torch.cat(parts)
    assert scale.mean == pytest.approx(float(everything.mean()), rel=1e-4)
    assert scale.std == pytest.approx(float(everything.std(correction=0)), rel=1e-4)
    torch.testing.assert_close(scale.restore(scale.normalise(parts[0])), parts[0])


def test_scale_of_returns_forgets_beyond_its_window() -> None:
    """Returns grow while one learns."""
    scale = ReturnScale(enabled=True, window_steps=100)
    for _ in range(30):
        scale.update(torch.zeros(100) + 1000)
    for _ in range(30):
        scale.update(torch.randn(100))
    assert abs(scale.mean) < 1.0
    assert scale.std < 2.0


def test_explained_variance_and_correlation_by_hand() -> None:
    """Of perfection, of a constant, and 0 where nothing varies but rounding."""
    actual = torch.tensor([1.0, 2.0, 4.0])
    assert explained_variance(actual, actual) == pytest.approx(1.0)
    assert explained_variance(torch.zeros(3), actual) == pytest.approx(0.0)
    assert correlation(actual, -2 * actual + 1) == pytest.approx(-1.0)
    for constant in (torch.ones(3), torch.full((3,), 0.1)):
        assert explained_variance(actual, constant) == correlation(actual, constant) == 0.0


@pytest.mark.parametrize("unit", [2.0**-60, 2.0**-20, 2.0**30])
def test_the_unit_of_returns_does_not_matter(unit: float) -> None:
    """Nothing is too small to be told from rounding by itself."""
    target, predicted = torch.randn(50) + 3, torch.randn(50)
    one, other = (ReturnScale(enabled=True, window_steps=100) for _ in range(2))
    for _ in range(3):
        one.update(target)
        other.update(unit * target)
    torch.testing.assert_close(other.normalise(unit * target), one.normalise(target))
    assert explained_variance(unit * predicted, unit * target) == pytest.approx(
        explained_variance(predicted, target)
    )
    assert correlation(unit * predicted, unit * target) == pytest.approx(
        correlation(predicted, target)
    )


def test_the_scale_of_returns_that_are_all_alike_is_no_rounding() -> None:
    """A millionth of them; and of none at all there is one that can be divided by."""
    alike, nothing = (ReturnScale(enabled=True, window_steps=100) for _ in range(2))
    alike.update(torch.full((10,), 3.0))
    assert alike.std == 3.0 * 2.0**-20
    nothing.update(torch.zeros(10))
    assert nothing.normalise(torch.zeros(3)).tolist() == [0.0] * 3
