"""Interquartile means with bootstrap confidence intervals, over few seeds.

Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice"
(the method of the package rliable): stratified bootstrap over the seeds of each task, percentiles.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Scores = npt.NDArray[np.float64]

_RESAMPLES = 10_000
_CURVE_RESAMPLES = 2_000


def iqm(scores: Scores) -> Scores:
    """Mean of the middle half along the last axis; the whole mean of fewer than four."""
    cut = scores.shape[-1] // 4
    middle = np.sort(scores, axis=-1)[..., cut : scores.shape[-1] - cut]
    return np.asarray(middle.mean(axis=-1))


def interval(scores: list[list[float]], seed: int = 0) -> tuple[float, float, float]:
    """The interquartile mean over tasks and seeds, and its 95 % confidence interval.

    Args:
        scores: One list of seeds for each task; tasks must be on one scale.
        seed: Of the bootstrap.

    Returns:
        The mean, and the lower and upper end.
    """
    rng = np.random.default_rng(seed)
    tasks = [np.asarray(task) for task in scores]
    drawn = [task[rng.integers(len(task), size=(_RESAMPLES, len(task)))] for task in tasks]
    low, high = np.percentile(iqm(np.concatenate(drawn, axis=1)), [2.5, 97.5])
    return float(iqm(np.concatenate(tasks))), float(low), float(high)


def band(scores: Scores, seed: int = 0) -> tuple[Scores, Scores]:
    """The 95 % interval of the interquartile mean at every point of a curve: ``[P, S]`` to ``[P]``.

    The seeds are resampled whole, once for all points.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.integers(scores.shape[1], size=(_CURVE_RESAMPLES, scores.shape[1]))
    low, high = np.percentile(iqm(scores[:, drawn]), [2.5, 97.5], axis=1)
    return low, high


class Comparison(NamedTuple):
    """How much larger the scores of one way of learning are than those of another, one task."""

    difference: float  # of the interquartile means
    low: float  # of its 95 % interval
    high: float
    ratio: float  # of the interquartile means; NaN: theirs is 0
    improvement: float  # chance that a run of the one has a larger score than one of the other


def compare(ours: list[float], theirs: list[float], seed: int = 0) -> Comparison:
    """Compare the scores of two lists of seeds; both are resampled, each by itself.

    Source: Agarwal et al. 2021, the interval as in `interval`, probability of improvement of
    section 4.3 (ties count half).
    """
    rng = np.random.default_rng(seed)
    pair = [np.asarray(each, dtype=np.float64) for each in (ours, theirs)]
    one, other = (iqm(each[rng.integers(len(each), size=(_RESAMPLES, len(each)))]) for each in pair)
    low, high = np.percentile(one - other, [2.5, 97.5])
    means = [float(iqm(each)) for each in pair]
    above = np.sign(pair[0][:, None] - pair[1][None, :])
    return Comparison(
        means[0] - means[1],
        float(low),
        float(high),
        means[0] / means[1] if means[1] else math.nan,
        float(above.mean() + 1) / 2,
    )


def area(steps: Scores, mean: Scores) -> float:
    """Mean height of the curve of evaluations, by trapezia over the steps."""
    return float(np.trapezoid(mean, steps) / (steps[-1] - steps[0]))
