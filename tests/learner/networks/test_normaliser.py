"""The normaliser against moments of everything that it saw."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.networks.normaliser import Normaliser


def test_normaliser_has_the_moments_of_everything_it_saw() -> None:
    """However it was divided into batches."""
    normaliser = Normaliser(3, enabled=True)
    parts = [torch.randn(50, 3) * 4 + 9, torch.randn(7, 3), torch.randn(200, 3) - 3]
    for part in parts:
        normaliser.update(part)
    everything = torch.cat(parts).double()
    torch.testing.assert_close(normaliser.mean, everything.mean(0))
    torch.testing.assert_close(normaliser.variance, everything.var(0, correction=0))
    assert float(normaliser.count) == 257.0
    seen = normaliser(torch.cat(parts))
    torch.testing.assert_close(seen.mean(0), torch.zeros(3), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(("one_in", "seen_as"), [(2, 0.5), (20, 0.218), (1000, 0.0316)])
def test_the_rarer_an_observation_the_quieter(one_in: int, seen_as: float) -> None:
    """With p = 1 / one_in it is sqrt((1 - p) / p) deviations from the mean, then p of that.

    Whatever its size, and however it was divided into batches.
    """
    contact = torch.zeros(one_in, 1)
    contact[-1] = 300.0
    quiet, loud = (Normaliser(1, enabled=True, quiets_rare=q) for q in (True, False))
    for normaliser in (quiet, loud):
        for part in torch.split(contact, 3):
            normaliser.update(part)
    assert float(quiet(contact[-1])) == pytest.approx(seen_as, rel=3e-3)
    assert float(loud(contact[-1])) == pytest.approx(min((one_in - 1) ** 0.5, 10.0), rel=1e-4)


def test_what_is_never_0_is_no_quieter_and_nothing_is_before_the_first() -> None:
    obs = torch.randn(99, 2) + 0.1
    quiet, loud = (Normaliser(2, enabled=True, quiets_rare=q) for q in (True, False))
    assert torch.equal(quiet(obs), loud(obs))
    for normaliser in (quiet, loud):
        normaliser.update(obs)
    assert torch.equal(quiet(obs), loud(obs))


def _of(*columns: list[float]) -> tuple[Normaliser, torch.Tensor]:
    """A normaliser that has seen these observations, ``[N, D]``, and what they are for it."""
    obs = torch.tensor(columns).T
    normaliser = Normaliser(len(columns), enabled=True)
    normaliser.update(obs)
    return normaliser, normaliser(obs)


@pytest.mark.parametrize("unit", [1e-30, 1e-6, 1.0, 1e9])
def test_the_unit_of_an_observation_does_not_matter(unit: float) -> None:
    """Mean 3, deviation 2: -1 and 1, whatever they are counted in."""
    _, seen = _of([unit, 5 * unit])
    torch.testing.assert_close(seen, torch.tensor([[-1.0], [1.0]]))


def test_what_never_changed_is_quiet_when_it_first_changes() -> None:
    """Always 0, and always 8.9; until it is learned from, a change is not seen."""
    normaliser, seen = _of([0.0, 0.0], [8.9, 8.9], [1.0, -1.0])
    assert seen.tolist() == [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    changed = torch.tensor([[5.0, 9.9, 1.0]])
    torch.testing.assert_close(normaliser(changed), torch.tensor([[0.0, 0.0, 1.0]]))
    normaliser.update(changed)
    assert (normaliser(changed)[0, :2] > 1.0).all()  # one of three: the root of 2


def test_rounding_is_quiet_and_what_is_more_is_not() -> None:
    """Near 2^20 float32 has steps of an eighth, and the floor is 2^20 / 2^22, a quarter.

    Two neighbours deviate by 1/16, which is seen as (1/16)^2 / ((1/16)^2 + (1/4)^2) = 1/17.
    """
    million = 2.0**20
    normaliser, _ = _of([million, million + 0.125], [million, million + 8.0])
    _, factor = normaliser.constants()
    seen = factor * torch.tensor([1 / 16, 4.0])
    torch.testing.assert_close(seen, torch.tensor([1 / 17, 256 / 257]), rtol=1e-4, atol=0.0)


def test_what_float64_leaves_of_0_beside_others_is_quiet() -> None:
    """The sine of pi is 1e-16; a millionth is a number."""
    _, seen = _of([1e-16, -1e-16], [1e-6, -1e-6], [1.0, 2.0])
    assert float(seen[:, 0].abs().max()) < 1e-5
    torch.testing.assert_close(seen[:, 1], torch.tensor([1.0, -1.0]))


def test_one_reading_of_any_size_hides_no_other() -> None:
    """What stands for "nothing there" is finite, the others are seen as they were."""
    most = torch.finfo(torch.float32).max
    normaliser, seen = _of([0.0, most], [1.0, -1.0], [-most, -most])
    torch.testing.assert_close(seen, torch.tensor([[-1.0, 1.0, 0.0], [1.0, -1.0, 0.0]]))
    assert normaliser(torch.tensor([[most, most, 0.0], [-most, 0.0, -most]])).isfinite().all()


def test_what_float32_can_hardly_hold_is_finite() -> None:
    """Its deviation is no number that float32 can divide 1 by."""
    normaliser, seen = _of([1e-44, 0.0])
    assert seen.isfinite().all()
    assert normaliser(torch.tensor([[1.0]])).isfinite().all()


@given(power=st.integers(-40, 40), seed=st.integers(0, 1000), quiets_rare=st.booleans())
def test_scaling_all_observations_changes_nothing(power: int, seed: int, quiets_rare: bool) -> None:
    """Among them one that is always 0, one that never changes, one that is rounding alone."""
    draw = torch.Generator().manual_seed(seed)
    obs = torch.randn(20, 6, generator=draw) * torch.tensor([1.0, 1e-3, 1e3, 0.0, 0.0, 1e-8]) + (
        torch.tensor([0.0, 1.0, -5.0, 0.0, 0.7, 1.0])
    )
    one, other = (Normaliser(6, enabled=True, quiets_rare=quiets_rare) for _ in range(2))
    for part in torch.split(obs, 7):
        one.update(part)
        other.update(part * 2.0**power)
    new = obs + torch.randn(20, 6, generator=draw)
    found = other(new * 2.0**power)
    torch.testing.assert_close(found, one(new))
    assert found.isfinite().all()


def test_ordinary_observations_are_divided_by_their_deviation() -> None:
    """To seven digits."""
    obs = torch.randn(500, 4, generator=torch.Generator().manual_seed(0)) * 0.3 + 1.0
    normaliser = Normaliser(4, enabled=True)
    normaliser.update(obs)
    _, factor = normaliser.constants()
    torch.testing.assert_close(factor, 1.0 / obs.std(0, correction=0), rtol=3e-7, atol=0.0)


def test_normaliser_limits_what_is_far_away() -> None:
    """One wild reading must not saturate a network."""
    normaliser = Normaliser(1, enabled=True)
    normaliser.update(torch.randn(100, 1))
    assert normaliser(torch.tensor([[1e6], [-1e6]])).tolist() == [[10.0], [-10.0]]


def test_normaliser_that_is_off_changes_nothing() -> None:
    """The authors have none."""
    normaliser = Normaliser(2, enabled=False)
    obs = torch.randn(5, 2) * 100
    normaliser.update(obs)
    assert normaliser(obs) is obs
    assert float(normaliser.count) == 0.0
