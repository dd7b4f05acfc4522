"""Aggregates over seeds: rliable's method, by hand."""

import numpy as np
import pytest
from scores import interval, iqm


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
