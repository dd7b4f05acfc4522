"""Compare two labels of a suite: python benchmarks/compare.py SUITE LABEL OTHER.

For each environment the area under the evaluations (mean action, 10 episodes, the same for all) and
their last five; what was seen at most after half the run, and at least after that; and how long the
run took. Interquartile means over the seeds, and 95 % intervals of the difference.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from scores import Scores, area, compare
from suites import SUITES, kept_evaluations, name_of

HERE = Path(__file__).parent
_LAST = 5


def read(suite: str, env: str, label: str, seed: int) -> tuple[Scores, Scores]:
    """Steps and mean returns of a run's evaluations."""
    file = kept_evaluations(HERE / SUITES[suite].folder, suite, name_of(suite, env, label, seed))
    with file.open(newline="") as lines:
        rows = [(float(r["env_steps"]), float(r["mean"])) for r in csv.DictReader(lines)]
    steps, mean = np.array(rows).T
    return steps, mean


def summary(steps: Scores, mean: Scores, total: int) -> tuple[float, float, float]:
    """Area, mean of the last five, least in the second half as a share of the best before it."""
    late = steps > total / 2
    so_far = np.maximum.accumulate(mean)
    kept = (mean[1:] / np.maximum(so_far[:-1], 1.0))[late[1:]]
    return area(steps, mean), float(mean[-_LAST:].mean()), float(kept.min())


def page(suite: str, label: str, other: str) -> str:
    """The comparison in Markdown; every seed."""
    found = SUITES[suite]
    lines = [
        f"| {suite}, {len(found.seeds)} seeds | {label} | {other} | difference [95 %] | ratio "
        f"| P({label} > {other}) |",
        "|---|---|---|---|---|---|",
    ]
    seeds = []
    for env in found.envs:
        both = {
            each: [summary(*read(suite, env, each, seed), found.steps) for seed in found.seeds]
            for each in (label, other)
        }
        for index, name in enumerate(("area", "last five")):
            one, two = ([run[index] for run in both[each]] for each in (label, other))
            c = compare(one, two)
            lines.append(
                f"| {env}, {name} | {np.mean(one):.0f} ± {np.std(one, ddof=1):.0f} | "
                f"{np.mean(two):.0f} ± {np.std(two, ddof=1):.0f} | "
                f"{c.difference:.0f} [{c.low:.0f}, {c.high:.0f}] | {c.ratio:.2f} | "
                f"{c.improvement:.2f} |"
            )
        for each in (label, other):
            told = ", ".join(f"{last:.0f} ({kept:.2f})" for _, last, kept in both[each])
            seeds.append(f"- {env}, {each}: {told}")
    about = "Last five of every seed; in brackets the least late evaluation by the best before it."
    return "\n".join([*lines, "", about, "", *seeds, ""])


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("label")
    parser.add_argument("other")
    arguments = parser.parse_args()
    sys.stdout.write(page(arguments.suite, arguments.label, arguments.other))


if __name__ == "__main__":
    main()
