"""Whole runs as a user starts them: real processes, real zenoh, real kills."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from system_helpers import (
    FAST,
    OFTEN,
    PATIENCE_S,
    REACH,
    Start,
    is_alive,
    metrics_port,
    rows,
    scrape,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
RunA2S = Callable[..., dict[str, Any]]


def _summary(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((path / "summary.json").read_text())
    return found


def _assert_balance(segments: dict[str, int]) -> None:
    parts = (segments[k] for k in ("accepted", "stale", "refused", "lost"))
    assert segments["sent"] == sum(parts), segments


def _updates(path: Path) -> int:
    file = path / "updates.csv"
    return len(file.read_text().splitlines()) - 1 if file.exists() else 0


def test_two_terminals_in_either_order(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """The actor comes first and waits; the learner tells it everything."""
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    wait_for(lambda: len(actor.workers()) == 2, "two workers")
    learner = start("learner", *REACH, *FAST, "--listen", endpoint, "--total-steps", "2000")
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    summary = _summary(tmp_path / "runs" / "default")
    assert summary["env_steps"] >= 2000
    assert summary["finished"]
    assert f"{summary['env_steps']:,} steps in" in learner.text()
    _assert_balance(summary["segments"])
    assert actor.process.poll() is None  # actors outlive the learner
    port = metrics_port(actor)
    wait_for(lambda: scrape(port)['a2s_actor_joins_total{worker="0"}'] == 1, "the join to be seen")
    workers = actor.workers()
    assert actor.end(signal.SIGINT) == 130
    assert not any(is_alive(worker.pid) for worker in workers)


@pytest.mark.parametrize(
    "settings",
    [pytest.param((), marks=pytest.mark.long), OFTEN],
    ids=["without recovery", "with recoveries"],
)
def test_lockstep_is_reproducible_to_the_bit(
    run_a2s: RunA2S, tmp_path: Path, settings: tuple[str, ...]
) -> None:
    """Two actors race each other differently in both runs; nothing of it is to be seen."""
    options = (
        "--env", "InvertedPendulum-v5", *FAST, *settings, "--lockstep", "--seed", "7", "--n", "2",
    )  # fmt: skip
    summaries = [
        run_a2s("train", *options, "--total-steps", "3000", "--run", name, "--episodes", "1")
        for name in ("one", "two")
    ]
    one, two = (tmp_path / "runs" / name for name in ("one", "two"))
    assert rows(one / "episodes.csv", without="wall_s") == rows(
        two / "episodes.csv", without="wall_s"
    )
    assert rows(one / "updates.csv", without="wall_s") == rows(
        two / "updates.csv", without="wall_s"
    )
    same = ("weights_sha256", "evaluation", "segments", "recoveries")
    assert [summaries[0][key] for key in same] == [summaries[1][key] for key in same]
    assert (summaries[0]["recoveries"] > 0) is bool(settings)


def test_a_killed_actor_is_replaced_and_the_accounts_balance(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    path = tmp_path / "run"
    learner = start(
        "learner", *REACH, *FAST, "--listen", endpoint, "--total-steps", "12000",
        "--run-dir", str(path), "--metrics-port", "0", "--n", "2",
    )  # fmt: skip
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    wait_for(lambda: _updates(path) >= 3, "three updates")
    victim = actor.workers()[0]
    os.kill(victim.pid, signal.SIGKILL)
    wait_for(lambda: not is_alive(victim.pid), "the death of the worker")
    wait_for(lambda: len(actor.workers()) == 2, "a replacement", timeout_s=5.0)
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    summary = _summary(path)
    _assert_balance(summary["segments"])
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    assert [e["slot"] for e in events if e["event"] == "join"][2:] != []
    assert [e["reason"] for e in events if e["event"] == "leave"][:1] == ["lost"]
    seen = scrape(metrics_port(actor))
    assert sum(seen[f'a2s_actor_restarts_total{{worker="{i}"}}'] for i in range(2)) == 1


def test_a_killed_learner_resumes_and_the_same_actors_go_on(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    path = tmp_path / "run"
    options = ("--listen", endpoint, "--run-dir", str(path), "--metrics-port", "0")
    learner = start("learner", *REACH, *FAST, *options, "--total-steps", "12000", "--n", "2")
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    wait_for(lambda: _updates(path) >= 25, "a checkpoint")
    workers = {worker.pid for worker in actor.workers()}
    learner.process.kill()
    learner.process.wait()
    assert not (path / "summary.json").exists()
    again = start("learner", *options, "--resume")
    assert again.process.wait(PATIENCE_S) == 0, again.text()
    assert {worker.pid for worker in actor.workers()} == workers
    summary = _summary(path)
    assert summary["finished"]
    _assert_balance(summary["segments"])
    updates = (path / "updates.csv").read_text().splitlines()[1:]
    numbers = [int(line.split(",")[0]) for line in updates]
    assert numbers == list(range(1, len(numbers) + 1))
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    assert [e["generation"] for e in events if e["event"] == "start"] == [1, 2]


@pytest.mark.long
def test_actors_go_on_with_a_learner_that_begins_anew(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """It knows nothing of the versions that they have: it is a start of another run."""
    options = (*REACH, *FAST, "--listen", endpoint, "--metrics-port", "-1", "--n", "2")
    first = start("learner", *options, "--total-steps", "10000000", "--run-dir", "one")
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    wait_for(lambda: _updates(tmp_path / "one") >= 25, "versions that the next will not reach soon")
    workers = {worker.pid for worker in actor.workers()}
    first.process.kill()
    first.process.wait()
    again = start("learner", *options, "--total-steps", "3000", "--run-dir", "two")
    assert again.process.wait(PATIENCE_S) == 0, again.text()
    assert {worker.pid for worker in actor.workers()} == workers
    _assert_balance(_summary(tmp_path / "two")["segments"])


def test_ctrl_c_stops_a_training_cleanly(start: Start, tmp_path: Path, wait_for: WaitFor) -> None:
    path = tmp_path / "run"
    train = start(
        "train", *REACH, *FAST, "--total-steps", "10000000", "--run-dir", str(path),
        "--metrics-port", "-1",
    )  # fmt: skip
    wait_for(lambda: _updates(path) >= 2, "two updates")
    everyone = psutil.Process(train.process.pid).children(recursive=True)
    assert len(everyone) >= 4  # learner, actor, two workers
    assert train.end(signal.SIGINT) == 130, train.text()
    assert not any(is_alive(process.pid) for process in everyone)
    assert _summary(path)["finished"] is False
    assert any((path / "checkpoints").iterdir())


def test_nobody_survives_a_killed_train(start: Start, tmp_path: Path, wait_for: WaitFor) -> None:
    path = tmp_path / "run"
    train = start("train", *REACH, *FAST, "--total-steps", "10000000", "--run-dir", str(path))
    wait_for(lambda: _updates(path) >= 1, "an update")
    everyone = psutil.Process(train.process.pid).children(recursive=True)
    train.process.kill()
    train.process.wait()
    wait_for(lambda: not any(is_alive(p.pid) for p in everyone), "all to end")


def test_an_actor_holds_no_torch_and_little_memory(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """Measured in a worker that has acted; 250 MB resident is the promise."""
    path = tmp_path / "run"
    start(
        "learner", "--env", "HalfCheetah-v5", *FAST, "--listen", endpoint, "--run-dir", str(path),
        "--metrics-port", "-1", "--total-steps", "10000000",
    )  # fmt: skip
    actor = start("actor", "--n", "1", "--connect", endpoint, "--metrics-port", "-1")
    wait_for(lambda: _updates(path) >= 2, "two updates")
    (worker,) = actor.workers()
    mapped = [m.path for m in worker.memory_maps()]
    assert not [m for m in mapped if "/torch/" in m]
    assert worker.memory_info().rss < 250e6


def test_actors_that_cannot_work_end_the_training_with_the_reason(
    start: Start, tmp_path: Path
) -> None:
    train = start("train", "--env", "a2s_test_envs:Crash-v0", *FAST, "--run-dir", "run")
    assert train.process.wait(PATIENCE_S) == 1
    last = train.text().strip().splitlines()[-1]
    assert "died 5 times" in last
    assert "the simulator is broken" in last
    assert "Traceback" not in train.text()
