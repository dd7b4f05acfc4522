"""Interquartile means with bootstrap confidence intervals, over few seeds.

Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice"
(the method of the package rliable): stratified bootstrap over the seeds of each task, percentiles.
"""

import numpy as np
import numpy.typing as npt

Scores = npt.NDArray[np.float64]

_RESAMPLES = 10_000


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
