"""``a2s compare``: what runs are worth beside each other, with intervals over their seeds."""

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2s.commands.plot import Curve, identity, read_curve
from a2s.commands.statistics import area, compare, interval
from a2s.learner.numerals import written
from a2s.learner.run import config as configuration
from a2s.learner.run.directory import CONFIG, EPISODES, UPDATES, evaluations
from a2s.protocol.errors import RunDirectoryError, UsageError

_LAST = 5  # evaluations
_LAST_SHARE = 0.1  # of the steps, where there are no evaluations
_FEW = 3
_ALIKE = 0.9  # of the longest run


class Worth(NamedTuple):
    """What a run is worth: mean height of its curve, and its end."""

    area: float
    final: float


def compare_runs(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """Group runs by environment and way of learning, and compare each group with the first.

    The order is that of ``runs``. If all runs of an environment were evaluated while training, the
    evaluations count (by the mean action), else the returns of training.

    Returns:
        The JSON object of ``a2s compare --json``: for each group ``env``, ``label``, ``of``
        (``evaluations`` or ``training``), ``seeds``, ``env_steps`` and ``seed`` of each, and under
        ``area`` and ``final`` the interquartile mean and its 95 % interval; and of what differs
        from the first group. What is not finite is ``None``.

    Raises:
        UsageError: One is not a run directory, or has no return yet.
    """
    groups: dict[str, dict[str, list[Path]]] = {}
    places = [run.resolve() for run in runs]
    if len(set(places)) < len(places):
        raise UsageError("a2s compare: found a run twice, expected each once")
    for run in runs:
        env, label = identity(run)
        groups.setdefault(env, {}).setdefault(label, []).append(run)
    found = []
    for env, by_label in groups.items():
        everyone = [run for members in by_label.values() for run in members]
        is_evaluated = all(_evaluations(run) is not None for run in everyone)
        first: list[Worth] | None = None
        for label, members in by_label.items():
            worth = [worth_of(run, evaluated=is_evaluated) for run in members]
            of = "evaluations" if is_evaluated else "training"
            row: dict[str, Any] = {"env": env, "label": label, "of": of, "seeds": len(members)}
            row["env_steps"] = [_steps(run) for run in members]
            row["seed"] = [_seed(run) for run in members]
            for name in Worth._fields:
                row[name] = _measure(name, worth, first)
            found.append(row)
            first = first or worth
    return found


def worth_of(run: Path, *, evaluated: bool) -> Worth:
    """What a run is worth by its evaluations, or by its training returns.

    Raises:
        UsageError: There is nothing to judge by.
    """
    found = _evaluations(run) if evaluated else None
    steps, returns = read_curve(run / EPISODES) if found is None else found
    if found is not None:
        last = returns[-_LAST:]
    else:
        last = returns[steps > (1.0 - _LAST_SHARE) * steps[-1]]
    height = area(steps, returns) if steps[-1] > steps[0] else float(returns.mean())
    return Worth(height, float(last.mean()))


def _steps(run: Path) -> int:
    """Its length: with short episodes the last one that is counted may end long before the run."""
    last = read_curve(run / EPISODES)[0][-1]
    with suppress(UsageError):  # it has learned nothing yet
        last = max(last, read_curve(run / UPDATES, "update")[0][-1])
    return int(last)


def _seed(run: Path) -> object:
    options, _ = configuration.read(run / CONFIG)
    return options.get("seed", 0)


def _evaluations(run: Path) -> tuple[Curve, Curve] | None:
    try:
        found = evaluations(run, "mean")
    except RunDirectoryError as error:
        raise UsageError(str(error)) from None
    if not found:
        return None
    steps, returns = np.array(sorted((each.env_steps, each.mean) for each in found)).T
    return steps, returns


def _measure(name: str, worth: list[Worth], first: list[Worth] | None) -> dict[str, float | None]:
    ours = [float(getattr(each, name)) for each in worth]
    iqm, low, high = interval([ours])
    told: dict[str, float | None] = {"iqm": iqm, "low": low, "high": high}
    if first is not None:
        theirs = [float(getattr(each, name)) for each in first]
        told |= dict(zip(_OF_DIFFERENCE, compare(ours, theirs), strict=True))
    return {name: v if v is not None and math.isfinite(v) else None for name, v in told.items()}


_OF_DIFFERENCE = (
    "difference", "difference_low", "difference_high", "ratio", "probability_of_improvement",
)  # fmt: skip


def page(found: Sequence[dict[str, Any]]) -> str:
    """Write the result of `compare_runs` for a reader."""
    lines: list[str] = []
    env = ""
    for row in found:
        if row["env"] != env:
            env = row["env"]
            lines += ([""] if lines else []) + [f"{env}, by {row['of']}"]
        seeds = "1 seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
        low, high = min(row["env_steps"]), max(row["env_steps"])
        steps = f"{low:,}" if low == high else f"{low:,} to {high:,}"
        lines.append(f"  {row['label']} ({seeds}, {steps} steps)")
        for name, words in (("area", "mean over the run"), ("final", "at its end")):
            lines.append(f"    {words:<18} {_of(row[name])}")
        if len(set(row["seed"])) < row["seeds"]:
            lines.append("    some runs have the same seed, and are no sample of what seeds do")
        if row["seeds"] < _FEW:
            lines.append("    an interval of so few seeds says little")
        if low < _ALIKE * max(max(each["env_steps"]) for each in found if each["env"] == env):
            lines.append("    runs of other lengths are not alike: train all to the same steps")
    return "\n".join(lines)


def _of(told: dict[str, Any]) -> str:
    if told["iqm"] is None:
        return "no finite number"
    line = f"{written(told['iqm'])} [{written(told['low'])}, {written(told['high'])}]"
    if "difference" not in told:
        return line
    if told["difference"] is None:
        return line
    difference, low, high = (
        f"{told[name]:+.4g}" for name in ("difference", "difference_low", "difference_high")
    )
    better = f"better with probability {told['probability_of_improvement']:.2f}"
    return f"{line}   {difference} [{low}, {high}] from the first, {better}"
