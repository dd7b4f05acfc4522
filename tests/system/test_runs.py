"""Whole runs as a user starts them: real processes, real zenoh, real kills."""

import json
import os
import shlex
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from case_runs import events
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
    options = ("--env", "HalfCheetah-v5", *FAST, "--listen", endpoint, "--total-steps", "2000")
    learner = start("learner", *options)
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
    for worker in workers:  # 250 MB resident without torch is the promise
        assert not [m.path for m in worker.memory_maps() if "/torch/" in m.path]
        assert worker.memory_info().rss < 250e6
    assert actor.end(signal.SIGINT) == 130
    assert not any(is_alive(worker.pid) for worker in workers)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param((), marks=pytest.mark.long),
        OFTEN,
        pytest.param((*OFTEN, "--set", "act_while_learning=true"), marks=pytest.mark.long),
    ],
    ids=["without recovery", "with recoveries", "acting while learning"],
)
def test_lockstep_is_reproducible_to_the_bit(
    run_a2s: RunA2S, tmp_path: Path, settings: tuple[str, ...]
) -> None:
    """Two actors race each other differently in both runs; nothing of it is to be seen.

    Nor of how the environments are stepped.
    """
    options = (
        "--env", "InvertedPendulum-v5", *FAST, *settings, "--lockstep", "--seed", "7", "--n", "2",
    )  # fmt: skip
    summaries = [
        run_a2s("train", *options, "--total-steps", "1500", "--run", name, "--episodes", "1", fast)
        for name, fast in (("one", "--fast-envs"), ("two", "--no-fast-envs"))
    ]
    one, two = (tmp_path / "runs" / name for name in ("one", "two"))
    for table in ("episodes.csv", "updates.csv"):
        assert rows(one / table, without="wall_s") == rows(two / table, without="wall_s")
    same = ("weights_sha256", "evaluation", "segments", "recoveries")
    assert [summaries[0][key] for key in same] == [summaries[1][key] for key in same]
    assert (summaries[0]["recoveries"] > 0) is bool(settings)


def test_a_killed_actor_is_replaced_and_the_accounts_balance(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    path = tmp_path / "run"
    learner = start(
        "learner", *REACH, *FAST, "--listen", endpoint, "--total-steps", "10000000",
        "--run-dir", str(path), "--metrics-port", "0", "--n", "2",
    )  # fmt: skip
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    wait_for(lambda: _updates(path) >= 3, "three updates")
    victim = actor.workers()[0]
    os.kill(victim.pid, signal.SIGKILL)
    wait_for(lambda: not is_alive(victim.pid), "the death of the worker")
    wait_for(lambda: len(actor.workers()) == 2, "a replacement", timeout_s=5.0)
    wait_for(lambda: len(events(path, "join")) == 3, "its join")
    assert [event["reason"] for event in events(path, "leave")] == ["lost"]
    seen = scrape(metrics_port(actor))
    assert sum(seen[f'a2s_actor_restarts_total{{worker="{i}"}}'] for i in range(2)) == 1
    assert learner.end(signal.SIGINT) == 130, learner.text()
    words = ["a2s", "learner", "--resume", "--run-dir", str(path), "--listen", endpoint]
    said = f"stopped     go on with: {shlex.join(words)} --metrics-port 0\n"
    assert said in learner.text()
    _assert_balance(_summary(path)["segments"])


def test_a_killed_learner_resumes_and_the_same_actors_go_on(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    path = tmp_path / "run"
    options = ("--listen", endpoint, "--run-dir", str(path), "--metrics-port", "0")
    learner = start("learner", *REACH, *FAST, *options, "--total-steps", "15000", "--n", "2")
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
    assert [event["generation"] for event in events(path, "start")] == [1, 2]
    assert "nothing to do" not in again.text()
    done = start("learner", *options, "--resume")
    assert done.process.wait(PATIENCE_S) == 0, done.text()
    assert "nothing to do: all steps are made; --total-steps for more" in done.text()
    assert "stopped" not in done.text()


def test_a_live_run_is_watched_and_found_by_the_doctor(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """From another terminal, by its name; every look is one JSON object."""
    place = ("--listen", endpoint, "--metrics-port", "-1", "--run", "seen", "--run-dir", "seen")
    learner = start("learner", *REACH, *FAST, *place, "--total-steps", "10000000", "--n", "1")
    actor = start("actor", "--connect", endpoint, "--run", "seen", "--metrics-port", "-1")
    wait_for(lambda: _updates(tmp_path / "seen") >= 1, "an update")
    look = ("--connect", endpoint, "--json")
    watcher = start("status", "--watch", "seen", "--json")
    stranger = start("status", *look)
    assert stranger.process.wait(PATIENCE_S) == 1
    said = "no answer for run 'default'; found run 'seen' there, name it with --run\n"
    assert said in stranger.text()
    doctor = start("doctor", "--connect", endpoint, "--run", "seen", "--json")
    assert doctor.process.wait(PATIENCE_S) == 0, doctor.text()
    states = {each["name"]: each["state"] for each in json.loads(doctor.text().splitlines()[-1])}
    assert states["learner"] == states["clock"] == "ok"
    assert "fail" not in states.values()
    assert learner.end(signal.SIGINT) == 130
    assert watcher.process.wait(PATIENCE_S) == 0, watcher.text()
    assert actor.end(signal.SIGINT) == 130
    looks = [json.loads(line) for line in watcher.text().splitlines() if line.startswith("{")]
    steps = [each["env_steps"] for each in looks]
    assert steps == sorted(steps)
    assert steps[-1] > steps[0] > 0
    assert {each["run"] for each in looks} == {"seen"}
    last = looks[-1]
    assert last["limited_by"] in ("learner", "environment", "selection", "network")
    assert last["actors"][0]["environment_s"] > 0


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


def test_a_training_serves_all_its_metrics_on_the_host_that_is_named(
    start: Start, tmp_path: Path
) -> None:
    place = ("--run-dir", "run", "--metrics-host", "127.0.0.2", "--metrics-port", "0")
    train = start("train", *REACH, *FAST, *place, "--total-steps", "300", "--episodes", "1")
    assert train.process.wait(PATIENCE_S) == 0
    for text in (train.text(), (tmp_path / "run" / "actors.log").read_text()):
        assert "http://127.0.0.2:" in text


@pytest.mark.long
def test_actors_that_cannot_work_end_the_training_with_the_reason(
    start: Start, tmp_path: Path
) -> None:
    train = start("train", "--env", "a2s_test_envs:Crash-v0", *FAST, "--run-dir", "run")
    assert train.process.wait(PATIENCE_S) == 1
    last = train.text().strip().splitlines()[-1]
    assert "died 5 times" in last
    assert "the simulator is broken" in last
    assert "Traceback" not in train.text()


def test_an_environment_that_is_not_there_is_told_by_the_learner_and_leaves_no_run(
    start: Start, tmp_path: Path
) -> None:
    """Its actors, which begin sooner, cannot find it either."""
    train = start("train", "--env", "./nope.py:Robot", "--run-dir", "run")
    assert train.process.wait(PATIENCE_S) == 2
    assert train.text().strip().endswith(f"found no such file, nor nope.py in {tmp_path}")
    assert not (tmp_path / "run").exists()
