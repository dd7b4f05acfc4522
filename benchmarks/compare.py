"""Compare labels of a suite: python benchmarks/compare.py SUITE LABEL OTHER [OTHER...].

With several others, the areas alone, a row for each. With one, for each environment the area under
the evaluations (mean action, 10 episodes, the same for all) and their last five; what was seen at
most after half the run, and at least after that; and how long the run took. Interquartile
means over the seeds, and 95 % intervals of the difference.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from suites import SUITES, kept_evaluations, name_of

from a2s.commands.statistics import Scores, area, compare

HERE = Path(__file__).parent
_LAST = 5
_COLUMNS = ("env_steps", "mean", "wall_s")
_WANTED = {"Hopper-v5": 3000, "Walker2d-v5": 4000, "HalfCheetah-v5": 5000}


class Evaluations(NamedTuple):
    """A run's: steps, mean returns, and seconds since it began."""

    steps: Scores
    mean: Scores
    wall_s: Scores


def read(suite: str, env: str, label: str, seed: int) -> Evaluations:
    """The kept evaluations of a run."""
    file = kept_evaluations(HERE / SUITES[suite].folder, suite, name_of(suite, env, label, seed))
    with file.open(newline="") as lines:
        rows = [[float(row[name]) for name in _COLUMNS] for row in csv.DictReader(lines)]
    return Evaluations(*np.array(rows).T)


def summary(run: Evaluations, total: int) -> tuple[float, float, float]:
    """Area, mean of the last five, least in the second half as a share of the best before it."""
    late = run.steps > total / 2
    so_far = np.maximum.accumulate(run.mean)
    kept = (run.mean[1:] / np.maximum(so_far[:-1], 1.0))[late[1:]]
    return area(run.steps, run.mean), float(run.mean[-_LAST:].mean()), float(kept.min())


def reached(run: Evaluations, wanted: float) -> tuple[float, float]:
    """Steps and seconds at the first evaluation that is as good as wanted; infinite if none is."""
    good = np.flatnonzero(run.mean >= wanted)
    if len(good) == 0:
        return np.inf, np.inf
    return float(run.steps[good[0]]), float(run.wall_s[good[0]])


def page(suite: str, label: str, other: str, seeds: Sequence[int]) -> str:
    """The comparison in Markdown; every seed."""
    found = SUITES[suite]
    lines = [
        f"| {suite}, seeds {min(seeds)} to {max(seeds)} | {label} | {other} "
        f"| difference [95 %] | ratio | P({label} > {other}) |",
        "|---|---|---|---|---|---|",
    ]
    runs, times = [], []
    for env in found.envs:
        both = {each: [read(suite, env, each, seed) for seed in seeds] for each in (label, other)}
        told = {each: [summary(run, found.steps) for run in both[each]] for each in both}
        for index, name in enumerate(("area", "last five")):
            one, two = ([run[index] for run in told[each]] for each in (label, other))
            c = compare(one, two)
            lines.append(
                f"| {env}, {name} | {np.mean(one):.0f} ± {np.std(one, ddof=1):.0f} | "
                f"{np.mean(two):.0f} ± {np.std(two, ddof=1):.0f} | "
                f"{c.difference:.0f} [{c.low:.0f}, {c.high:.0f}] | {c.ratio:.2f} | "
                f"{c.improvement:.2f} |"
            )
        for each in both:
            seen = ", ".join(f"{last:.0f} ({kept:.2f})" for _, last, kept in told[each])
            runs.append(f"- {env}, {each}: {seen}")
            goal = _WANTED[env]
            steps, wall = np.median([reached(run, goal) for run in both[each]], axis=0)
            times.append(f"- {env}, {each}, to {goal}: {steps:.0f} steps, {wall:.0f} s")
    about = "Last five of every seed; in brackets the least late evaluation by the best before it."
    return "\n".join([*lines, "", about, "", *runs, "", "Medians over the seeds:", "", *times, ""])


def areas(suite: str, label: str, others: Sequence[str], seeds: Sequence[int]) -> str:
    """The areas of all labels in Markdown, and by how much the first one is ahead of each."""
    envs = SUITES[suite].envs
    lines = [
        f"| {suite}, seeds {min(seeds)} to {max(seeds)} | {' | '.join(envs)} |",
        "|---" * (1 + len(envs)) + "|",
    ]
    total = SUITES[suite].steps

    def all_seeds(env: str, each: str) -> list[float]:
        return [summary(read(suite, env, each, seed), total)[0] for seed in seeds]

    firsts = {env: all_seeds(env, label) for env in envs}
    means = (f"{np.mean(firsts[env]):.0f}" for env in envs)
    lines.append(f"| {label} | {' | '.join(means)} |")
    for other in others:
        cells = []
        for env in envs:
            theirs = all_seeds(env, other)
            c = compare(firsts[env], theirs)
            cells.append(f"{np.mean(theirs):.0f}; {c.difference:+.0f} [{c.low:.0f}, {c.high:.0f}]")
        lines.append(f"| {other} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("label")
    parser.add_argument("others", nargs="+")
    parser.add_argument("--seeds", nargs="*", type=int, help="only these seeds")
    arguments = parser.parse_args()
    seeds = arguments.seeds or SUITES[arguments.suite].seeds
    told = (arguments.suite, arguments.label)
    if len(arguments.others) == 1:
        sys.stdout.write(page(*told, arguments.others[0], seeds))
    else:
        sys.stdout.write(areas(*told, arguments.others, seeds))


if __name__ == "__main__":
    main()
