"""Benchmarks: rates and ratios are what was counted, and every suite says its rows."""

import json
import time
from collections.abc import Callable

import pytest
from typer.testing import CliRunner

from a2s import cli
from a2s.commands import bench
from a2s.commands.bench import Contender, Contest
from a2s.learner.run.config import off_policy
from a2s.protocol.errors import UsageError

FASTEST = off_policy("sac", {}).precision


def _clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Callable[[], None]]:
    """Make calls that take as long as they say, on a clock that nothing else moves."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def taking(seconds: float) -> Callable[[], None]:
        def call() -> None:
            now[0] += seconds

        return call

    return taking


def _contest(monkeypatch: pytest.MonkeyPatch, *contenders: Contender) -> None:
    contests = [Contest("things/s", contenders)]
    monkeypatch.setattr("a2s.commands.bench_wire.contests", lambda _: contests)


def test_a_ratio_is_to_the_fastest_baseline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two things in 0.1 s are 20/s, beside baselines of 4/s and 5/s."""
    taking = _clock(monkeypatch)
    _contest(
        monkeypatch,
        Contender("ours", taking(0.1), 2.0),
        Contender("slow", taking(0.25), is_baseline=True),
        Contender("fast", taking(0.2), is_baseline=True),
    )
    ours, slow, fast = bench.bench("wire", 3, 1.0)
    assert ours == {
        "name": "ours", "value": 20.0, "unit": "things/s", "baseline": 5.0, "ratio": 4.0
    }  # fmt: skip
    assert (slow["value"], slow["ratio"], fast["ratio"]) == (4.0, 0.8, 1.0)


def test_without_a_baseline_there_is_no_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    _contest(monkeypatch, Contender("ours", _clock(monkeypatch)(0.5)))
    (row,) = bench.bench("wire", 1, 1.0)
    assert (row["value"], row["baseline"], row["ratio"]) == (2.0, None, None)


@pytest.mark.parametrize(
    ("suite", "names"),
    [
        ("actor", ["Hopper-v5: a2s, K 10", "HalfCheetah-v5: random actions"]),
        pytest.param(
            "learner",
            ["a2s sac, f32", f"a2s sac, {FASTEST}, K_target 4", f"a2s sac, {FASTEST}, two threads"],
            marks=pytest.mark.long,
        ),
        ("wire", ["encode: a2s", "acknowledged: zenoh", "acknowledged: bare tcp"]),
        ("replay", ["uniform sample: a2s, files", "open 1,000,000 rows"]),
    ],
)
@pytest.mark.slow
@pytest.mark.timeout(300)  # every contender compiles what it needs
def test_every_suite_measures_something(suite: str, names: list[str]) -> None:
    options = ["--rounds", "1", "--seconds", "0", "--json"]
    result = CliRunner().invoke(cli.app, ["bench", suite, *options])
    rows = json.loads(result.stdout.splitlines()[-1])
    assert all(list(row) == ["name", "value", "unit", "baseline", "ratio"] for row in rows)
    assert all(row["value"] > 0 for row in rows)
    assert set(names) <= {row["name"] for row in rows}


def test_an_unknown_suite_is_bad_usage_with_the_nearest_name() -> None:
    with pytest.raises(UsageError, match=r"unknown benchmark 'wires'.*wire"):
        bench.bench("wires", 1, 0.0)
