"""Tables of a suite in Markdown, from a results.csv."""

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from suites import SUITES, kept_episodes, name_of

from a2s.commands.plot import read_curve
from a2s.commands.statistics import interval

COLUMNS = {
    "mean": "mean action",
    "best_of_k": "best of K",
    "return_last_tenth": "training, last tenth",
    "return_best": "best episode",
    "wall_s": "seconds",
}
# Average over the seeds of the best published figures that a suite is held against.
UNIT = {"Hopper-v5": 2900.0, "Walker2d-v5": 3800.0, "HalfCheetah-v5": 6000.0}

Rows = list[dict[str, str]]


def tables(results: Path, suite: str, labels: Sequence[str]) -> str:
    """Write every seed of every environment, then the aggregates over seeds.

    Args:
        results: The file.
        suite: Whose rows.
        labels: In this order.
    """
    with results.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["suite"] == suite]
    by_env: dict[str, dict[str, Rows]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        by_env[row["env"]][row["label"]].append(row)
    parts = [_environment(results.parent, *group, labels) for group in by_env.items()]
    if UNIT.keys() >= by_env.keys():
        parts.append(_together(by_env, labels))
    return "\n".join(parts)


def _environment(folder: Path, env: str, groups: dict[str, Rows], labels: Sequence[str]) -> str:
    titles = (*COLUMNS.values(), "mean action of the seeds", "training, fifths of the run")
    lines = [f"### {env}", "", _row("", *titles), _row(*["---"] * (len(titles) + 1))]
    for label in labels:
        rows = groups.get(label, [])
        if not rows:
            continue
        cells = [_interval([float(r[c]) for r in rows if r[c]]) for c in COLUMNS]
        seeds = ", ".join(f"{float(r['mean']):.0f}" for r in rows)
        fifths = np.ma.mean(np.ma.masked_invalid([_fifths(folder, r) for r in rows]), axis=0)
        trained = ", ".join("-" if np.ma.is_masked(mean) else f"{mean:.0f}" for mean in fifths)
        lines.append(_row(label, *cells, seeds, trained))
    return "\n".join([*lines, ""])


def _fifths(folder: Path, row: dict[str, str]) -> list[float]:
    """Average the returns of the episodes that ended in each fifth of a run, NaN where none did."""
    name = name_of(row["suite"], row["env"], row["label"], int(row["seed"]))
    steps, returns = read_curve(kept_episodes(folder, row["suite"], name))
    fifth = np.minimum(4, 5 * steps // SUITES[row["suite"]].steps)
    ended = [returns[fifth == i] for i in range(5)]
    return [float(each.mean()) if len(each) else float("nan") for each in ended]


def _together(by_env: dict[str, dict[str, Rows]], labels: Sequence[str]) -> str:
    """Over all environments, each in units of its published figure."""
    lines = [f"### All of {', '.join(by_env)}", "", _row("", "mean action"), _row("---", "---")]
    for label in labels:
        scores = [
            [float(r["mean"]) / UNIT[env] for r in groups[label]]
            for env, groups in by_env.items()
            if label in groups and env in UNIT
        ]
        if len(scores) == len(by_env):
            lines.append(_row(label, "{:.2f} [{:.2f}, {:.2f}]".format(*interval(scores))))
    return "\n".join([*lines, ""])


def _interval(values: list[float]) -> str:
    if len(values) < 2:
        return f"{values[0]:,.0f}" if values else "-"
    return "{:,.0f} [{:,.0f}, {:,.0f}]".format(*interval([values]))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
