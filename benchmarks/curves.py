"""The curves of a suite, from the episodes that are kept of its runs."""

import csv
from collections.abc import Collection
from pathlib import Path

from suites import kept_episodes, name_of

from a2s.commands.plot import Panels, draw, read_curve


def curves(folder: Path, suite: str, labels: Collection[str], output: Path) -> None:
    """Draw every run of a suite that is in ``results.csv``, a panel for each environment.

    Args:
        folder: Where ``results.csv`` and ``episodes`` are.
        suite: Whose runs.
        labels: Which of them.
        output: The picture.
    """
    panels: Panels = {}
    with (folder / "results.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["suite"] == suite and r["label"] in labels]
    for row in rows:
        env, label, seed = row["env"], row["label"], int(row["seed"])
        curve = read_curve(kept_episodes(folder, suite, name_of(suite, env, label, seed)))
        panels.setdefault(env, {}).setdefault(label, []).append(curve)
    draw(panels, output)
