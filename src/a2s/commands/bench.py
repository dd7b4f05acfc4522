"""``a2s bench``: contenders take turns, so that other load on the machine affects all of them."""

import importlib
import logging
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

from a2s.protocol.errors import UsageError, nearest

logger = logging.getLogger(__name__)

SUITES = ("actor", "learner", "wire", "replay", "startup")


class Contender(NamedTuple):
    """One way of doing something.

    ``name`` is for the table; ``call`` does it once, which is worth ``size`` units. The others are
    compared to the fastest contender with ``is_baseline``.
    """

    name: str
    call: Callable[[], Any]
    size: float = 1.0
    is_baseline: bool = False


class Contest(NamedTuple):
    """Ways of doing the same, and the unit of all: of a rate, or of what calls give to read."""

    unit: str
    contenders: Sequence[Contender]
    is_reading: bool = False


def bench(suite: str, rounds: int, seconds: float) -> list[dict[str, Any]]:
    """Measure a suite, one of `SUITES`, on this machine.

    ``rounds`` are turns of every contender, after one that warms up; a turn takes at least
    ``seconds``.

    Returns:
        Rows ``{name, value, unit, baseline, ratio}``: medians over the rounds of the rate and of
        the fastest baseline, and of the ratio of both within a round; ``None`` without one.

    Raises:
        UsageError: The suite is unknown.
    """
    if suite not in SUITES:
        raise UsageError(f"unknown benchmark {suite!r}{nearest(suite, SUITES)}")
    contests_of = importlib.import_module(f"a2s.commands.bench_{suite}").contests
    with ExitStack() as stack:
        contests: list[Contest] = contests_of(stack)
        return [row for contest in contests for row in _hold(contest, rounds, seconds)]


def table(rows: list[dict[str, Any]]) -> str:
    """Lay out the results of `bench`."""
    lines = []
    for row in rows:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:8.2f} x the fastest other"
        lines.append(f"{row['name']:<44}{_number(row['value']):>14} {row['unit']:<14}{ratio}")
    return "\n".join(lines)


def optional(module: str, package: str) -> Any:
    """Import a peer to compare with, or say that it is missing and give ``None``."""
    try:
        return importlib.import_module(module)
    except ImportError:
        missing(package)
        return None


def missing(package: str) -> None:
    """Say that a peer is not installed."""
    logger.warning("%s is not here, so there is less to compare: pip install %s", package, package)


def _hold(contest: Contest, rounds: int, seconds: float) -> list[dict[str, Any]]:
    found: dict[str, list[float]] = {one.name: [] for one in contest.contenders}
    for turn in range(rounds + 1):
        for one in contest.contenders:
            value = one.call() if contest.is_reading else _rate(one, seconds)
            found[one.name] += [float(value)] if turn else []
    against = [found[one.name] for one in contest.contenders if one.is_baseline]
    fastest = [max(rates) for rates in zip(*against, strict=True)]
    return [
        {
            "name": name,
            "value": _median(rates),
            "unit": contest.unit,
            "baseline": _median(fastest),
            "ratio": _median([rate / best for rate, best in zip(rates, fastest, strict=False)]),
        }
        for name, rates in found.items()
    ]


def _rate(one: Contender, seconds: float) -> float:
    count, begin_s = 0, time.perf_counter()
    while (spent_s := time.perf_counter() - begin_s) < seconds or count == 0:
        one.call()
        count += 1
    return count * one.size / spent_s


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.6g}"


def _median(values: list[float]) -> float | None:
    return float(f"{statistics.median(values):.4g}") if values else None
