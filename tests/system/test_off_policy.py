"""The off-policy variant as a user starts it: real processes, a real replay, real kills."""

import json
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from system_helpers import OFF_POLICY, PATIENCE_S, REACH, Start, metrics_port, rows, scrape

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.replay import directory
from a2s.learner.replay.episodes import StoredEpisodes

KILLS = int(os.environ.get("KILLS", "2"))
pytestmark = [pytest.mark.system, pytest.mark.timeout(240 + 60 * KILLS)]

WaitFor = Callable[..., None]
RunA2S = Callable[..., dict[str, Any]]
SMALL = (*OFF_POLICY, "--set", "warm_up_steps=100")


def _acknowledged(run: Path) -> Ledger:
    """The ledger, which knows what was accepted."""
    ledger = Ledger(run / "segments.log")
    ledger.close()
    return ledger


@pytest.mark.long
def test_every_step_gets_its_update_and_is_in_the_replay(run_a2s: RunA2S, tmp_path: Path) -> None:
    summary = run_a2s("train", *REACH, *SMALL, "--n", "2", "--total-steps", "1500", "--run", "r")
    assert summary["variant"] == "off-policy"
    assert summary["segments"]["stale"] == 0
    run = tmp_path / "runs" / "r"
    replay = directory.look_at(run / "replay")
    assert replay.live.stop == _acknowledged(run).accepted_steps == summary["env_steps"] >= 1500
    ends = len(list(StoredEpisodes(run / "replay")))
    assert summary["episodes"] == ends == len(rows(run / "episodes.csv", without="wall_s")) - 1
    due = replay.live.stop - 100
    arrived_last = 256  # while the last round was learned from
    assert due - arrived_last <= summary["updates"] <= due + 16  # lead_steps
    assert np.isfinite(summary["evaluation"]["mean"])


def test_lockstep_is_reproducible_to_the_bit(run_a2s: RunA2S, tmp_path: Path) -> None:
    """With two actors, whichever is faster; so are the rows of the replay."""
    options = (*REACH, *SMALL, "--lockstep", "--n", "2", "--seed", "3", "--total-steps", "300")
    summaries = [run_a2s("train", *options, "--run", name) for name in ("one", "two")]
    one, two = (tmp_path / "runs" / name for name in ("one", "two"))
    for table in ("episodes.csv", "updates.csv"):
        assert rows(one / table, without="wall_s") == rows(two / table, without="wall_s")
    assert summaries[0]["weights_sha256"] == summaries[1]["weights_sha256"]
    first, second = (directory.look_at(run / "replay").obs_since(0) for run in (one, two))
    assert np.array_equal(first, second)


def test_half_of_the_steps_are_of_short_episodes_and_the_others_alone_are_counted(
    run_a2s: RunA2S, tmp_path: Path
) -> None:
    """After 8 steps of a whole one 3 + 3 + 3."""
    options = ("--set", "short_steps=3", "--total-steps", "340", "--n", "1", "--envs", "1")
    summary = run_a2s("train", *REACH, *SMALL, *options, "--run-dir", str(tmp_path / "run"))
    played = rows(tmp_path / "run" / "episodes.csv", without="wall_s")[1:]
    lengths = [row.split(",")[4] for row in played]
    assert lengths == ["8"] * summary["episodes"]
    assert summary["episodes"] == (summary["env_steps"] + 17 - 8) // 17


@pytest.mark.long
def test_a_resume_that_cannot_go_on_changes_nothing(
    start: Start, run_a2s: RunA2S, endpoint: str, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run_a2s("train", *REACH, *SMALL, "--total-steps", "300", "--run-dir", str(run))
    watched = [run / "config.toml", run / "segments.log", *(run / "replay").iterdir()]
    before = [(path, path.stat().st_size, path.read_bytes()) for path in watched]
    for options, words in (
        (("--env", "InvertedPendulum-v5"), "found off-policy on a2s_test_envs:Reach-v0, expected"),
        (("--variant", "on-policy"), "expected on-policy on a2s_test_envs:Reach-v0"),
        (("--set", "critic_sizes=32,32", "--set", "replay_rows=100"), "critics"),
    ):
        there = ("--run-dir", str(run), "--listen", endpoint, "--metrics-port", "-1")
        learner = start("learner", "--resume", *options, *there)
        assert learner.process.wait(PATIENCE_S) in (1, 2)
        assert words in learner.log.read_text().splitlines()[-1]
        assert [(path, path.stat().st_size, path.read_bytes()) for path in watched] == before
    again = ("train", "--resume", "--run-dir", str(run), "--total-steps", "400")
    assert run_a2s(*again)["env_steps"] >= 400


def test_kills_lose_no_acknowledged_transition_and_double_none(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """The learner is killed at random moments while four actors send."""
    run = tmp_path / "run"
    options = ("--listen", endpoint, "--run-dir", str(run), "--metrics-port", "0")
    learner = start("learner", *REACH, *SMALL, *options, "--n", "4", "--total-steps", "1000000")
    actor = start("actor", "--n", "4", "--connect", endpoint, "--metrics-port", "0")
    rng = random.Random(0)
    floor, log = 0, run / "segments.log"
    for _ in range(KILLS):
        aim = floor + 150 + rng.randrange(300)
        wait_for(lambda aim=aim: log.exists() and _steps(log) >= aim, f"{aim} steps", PATIENCE_S)
        os.kill(learner.process.pid, signal.SIGKILL)
        learner.process.wait()
        floor = _acknowledged(run).accepted_steps
        learner = start("learner", *options, "--resume")
    wait_for(lambda: _steps(run / "segments.log") > floor, "steps after the last kill")
    capacity = 'a2s_actor_outbox_capacity_transitions{worker="0"}'
    assert scrape(metrics_port(actor))[capacity] == 2 * 2 * 8  # quotas, environments, steps
    assert learner.end(signal.SIGINT) == 130
    begin_s = time.perf_counter()
    replay = directory.look_at(run / "replay")
    opened_s = time.perf_counter() - begin_s
    ledger = _acknowledged(run)
    assert replay.live.stop == ledger.accepted_steps
    counted = [json.loads(x) for x in (run / "events.jsonl").read_text().splitlines()]
    starts = [e["generation"] for e in counted if e["event"] == "start"]
    assert starts == list(range(1, KILLS + 2))

    def told(result: str) -> int:
        """Segments that the actors were answered so."""
        seen = scrape(metrics_port(actor))
        return int(sum(v for k, v in seen.items() if "acks_total" in k and f'"{result}"' in k))

    kept = ledger.accounts().accepted
    assert told("accepted") + told("duplicate") <= kept
    start("learner", *options, "--resume")
    # A duplicate had been accepted when a kill, or the end, swallowed the answer.
    known = f"{kept} segments known to the actors"
    wait_for(lambda: told("accepted") + told("duplicate") >= kept, known)
    print(f"{KILLS} kills: {replay.live.stop} steps, {kept} segments, opened in {opened_s:.3f} s")  # noqa: T201


def _steps(log: Path) -> int:
    lines = [line.split(" ") for line in log.read_text().splitlines(keepends=True)]
    whole = [line for line in lines if line[-1].endswith("\n")]
    return sum(int(steps) for _, _, verdict, steps, _ in whole if verdict == "accepted")
