"""Aggregates over seeds: rliable's method, by hand."""

import numpy as np
import pytest

from a2s.commands.statistics import area, band, compare, interval, iqm


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    assert iqm(np.array([[100.0, 1.0, 2.0, 3.0, -50.0, 4.0, 0.0, 9.0]])).tolist() == [2.5]
    assert float(iqm(np.array([1.0, 2.0, 9.0]))) == 4.0  # too few to leave any out


def test_the_interval_of_three_seeds_is_that_of_all_27_resamples() -> None:
    """Written out: 27 equally likely draws with replacement of three seeds."""
    seeds = np.array([1.0, 2.0, 6.0])
    means = [np.mean(seeds[list(draw)]) for draw in np.ndindex(3, 3, 3)]
    low, high = np.percentile(means, [2.5, 97.5], method="inverted_cdf")
    assert interval([seeds.tolist()]) == pytest.approx((3.0, low, high), abs=1e-9)


def test_each_task_keeps_its_number_of_seeds() -> None:
    """Otherwise two tasks of equal seeds would have a wide interval."""
    assert interval([[1.0, 1.0], [3.0, 3.0]]) == (2.0, 2.0, 2.0)


def test_a_comparison_by_hand() -> None:
    """All of ours are 2 larger than the largest of theirs; then they are the same."""
    found = compare([5.0, 5.0, 5.0], [3.0, 3.0, 3.0])
    assert found == (2.0, 2.0, 2.0, 5.0 / 3.0, 1.0)
    same = compare([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    assert (same.difference, same.ratio, same.improvement) == (0.0, 1.0, 0.5)
    assert same.low < 0.0 < same.high
    assert compare([1.0, 4.0], [2.0, 3.0]).improvement == 0.5


def test_the_area_is_the_mean_height_of_the_curve() -> None:
    """Half of it at 0, then up to 4 within a quarter, then there."""
    steps, mean = np.array([0.0, 2.0, 3.0, 4.0]), np.array([0.0, 0.0, 4.0, 4.0])
    assert area(steps, mean) == pytest.approx((0.0 + 2.0 + 4.0) / 4.0)


def test_the_band_of_a_curve_is_the_interval_at_each_point() -> None:
    """Where the seeds agree it has no width; elsewhere it is that of all 27 draws."""
    curve = np.array([[2.0, 2.0, 2.0], [1.0, 2.0, 6.0]])
    low, high = band(curve)
    means = [np.mean(curve[1][list(draw)]) for draw in np.ndindex(3, 3, 3)]
    expected = np.percentile(means, [2.5, 97.5], method="inverted_cdf")
    assert (low[0], high[0]) == (2.0, 2.0)
    assert [low[1], high[1]] == pytest.approx(expected.tolist(), abs=1e-9)


def test_a_ratio_to_nothing_is_no_number() -> None:
    assert np.isnan(compare([1.0], [0.0]).ratio)
