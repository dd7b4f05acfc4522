"""Benchmarks: rates and ratios are what was counted, and every suite says its rows."""

import json
import time
from collections.abc import Callable
from contextlib import closing

import pytest
from typer.testing import CliRunner

from a2s import cli
from a2s.commands import bench
from a2s.commands.bench import Contender, Contest
from a2s.commands.bench_load import Tally, load, rows
from a2s.commands.process import free_endpoint
from a2s.learner.run.config import off_policy
from a2s.protocol.errors import A2SError, UnreachableError, UsageError
from a2s.protocol.zenoh_bus import ZenohBus

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
        ("startup", ["actor: to its first step", "worker: resident", "learner: until it listens"]),
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


def test_a_load_for_a_run_that_nobody_answers_to_is_refused() -> None:
    """And not measured as one that is answered nothing."""
    endpoint = free_endpoint()
    with (
        closing(ZenohBus.listen(endpoint)),
        pytest.raises(UnreachableError, match=r"no answer for run 'nosuch'; name another with --"),
    ):
        load(1, connect=endpoint, run="nosuch", pace_s=0.0, seconds=0.1)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_load_of_actors_is_answered_by_a_learner_that_learns() -> None:
    options = ["--actors", "3", "--rounds", "4", "--seconds", "2", "--json"]
    result = CliRunner().invoke(cli.app, ["bench", "wire", *options])
    found = {row["name"]: row["value"] for row in json.loads(result.stdout.splitlines()[-1])}
    assert found["3 actors: accepted"] > 0
    assert found["3 actors: accepted steps"] >= found["3 actors: accepted"]
    assert 0 < found["3 actors: answer, median"] <= found["3 actors: answer, p99"]
    assert found["3 actors: weights, p99"] > 0  # it has published while they sent
    assert not found.keys() & {"3 actors: refused", "3 actors: unanswered"}


def test_percentiles_and_rates_are_of_what_was_counted() -> None:
    """Two of three segments accepted in 4 s, of 10 and 20 steps; before and after, nothing."""
    tally = Tally()
    tally.answer("accepted", 99, 1.0)
    tally.begin()
    seen = (("accepted", 10, 0.1), ("accepted", 20, 0.2), ("stale", 5, 0.3))
    for verdict, steps, seconds in seen:
        tally.answer(verdict, steps, seconds)
    tally.end()
    tally.answer("stale", 99, 1.0)
    found = {row["name"]: row["value"] for row in rows(3, tally, 4.0)}
    assert found["3 actors: accepted"] == 0.5
    assert found["3 actors: accepted steps"] == 7.5
    assert found["3 actors: stale"] == 0.25
    assert found["3 actors: answer, median"] == pytest.approx(200.0)
    assert found["3 actors: answer, p99"] == pytest.approx(298.0)
    assert found["3 actors: weights, p99"] is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("replay", "--actors", "2"), "found --actors, expected it with wire only"),
        (("wire", "--pace", "1"), "expected --actors N with them"),
        (("wire", "--actors", "2", "--connect", "tcp/127.0.0.1:9"), "no learner at"),
    ],
)
def test_a_load_that_cannot_be_is_one_line(words: tuple[str, ...], said: str) -> None:
    result = CliRunner().invoke(cli.app, ["bench", *words])
    assert said in str(result.exception)
    assert isinstance(result.exception, A2SError)


def test_what_is_read_is_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first turn warms up; the median of the others is told as it was read."""
    readings = iter([99.0, 3.0, 1.0, 2.0])
    contest = Contest("s", [Contender("start", lambda: next(readings))], is_reading=True)
    monkeypatch.setattr("a2s.commands.bench_startup.contests", lambda _: [contest])
    (row,) = bench.bench("startup", 3, 0.0)
    assert (row["value"], row["unit"], row["ratio"]) == (2.0, "s", None)


def test_an_unknown_suite_is_bad_usage_with_the_nearest_name() -> None:
    with pytest.raises(UsageError, match=r"unknown benchmark 'wires'.*wire"):
        bench.bench("wires", 1, 0.0)
