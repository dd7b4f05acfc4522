"""A second learner, from the replay of a first: offline from its files, live over the network."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from system_helpers import PATIENCE_S, REACH, Start
from typer.testing import CliRunner

from a2s.cli import app
from a2s.learner.replay import directory
from a2s.protocol.errors import A2SError

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

RunA2S = Callable[..., dict[str, Any]]
WaitFor = Callable[..., None]
SMALL = (
    "--set", "critic_sizes=16,16", "--set", "policy_sizes=16,16", "--set", "batch_rows=32",
    "--set", "warm_up_steps=100",
)  # fmt: skip
FILLS = (
    *REACH, *SMALL, "--variant", "off-policy", "--n", "1", "--envs", "2",
    "--set", "send_every_steps=8", "--set", "replay_rows=20000", "--metrics-port", "-1",
)  # fmt: skip


@pytest.mark.long
def test_offline_from_the_files_of_a_run_and_on_after_a_resume(
    run_a2s: RunA2S, tmp_path: Path
) -> None:
    run_a2s("train", *FILLS, "--total-steps", "600", "--run", "first")
    first = tmp_path / "runs" / "first"
    before = {path: path.read_bytes() for path in (first / "replay").iterdir()}
    learner = ("learner", "--replay-from", str(first), *SMALL, "--metrics-port", "-1")
    summary = run_a2s(*learner, "--total-steps", "300", "--run-dir", "second")
    assert (summary["env"], summary["updates"], summary["finished"]) == (REACH[1], 300, True)
    assert {path: path.read_bytes() for path in (first / "replay").iterdir()} == before
    again = run_a2s(*learner, "--total-steps", "500", "--run-dir", "second", "--resume")
    assert (again["updates"], again["env_steps"]) == (500, 500)
    rows = (tmp_path / "second" / "updates.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == [100, 200, 300, 400, 500]
    evaluation = run_a2s("evaluate", "second", "--episodes", "3")
    assert evaluation["mean"] > 6.0  # of 8; a random policy gets about 4


@pytest.mark.long
def test_live_over_the_network_without_a_change_to_the_first(
    start: Start, run_a2s: RunA2S, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """Its files are refused meanwhile: rows would be written over while they are drawn."""
    first = start(
        "learner", *FILLS, "--listen", endpoint, "--run-dir", "first", "--total-steps", "100000"
    )
    start("actor", "--n", "1", "--connect", endpoint, "--metrics-port", "-1")
    second = ("learner", "--replay-from", "default", "--connect", endpoint, *SMALL)
    options = ("--metrics-port", "-1", "--total-steps", "300", "--run-dir", "second")
    wait_for(lambda: (tmp_path / "first" / "replay").exists(), "a replay")
    summary = run_a2s(*second, *options)
    assert summary["updates"] == 300
    refused = start("learner", "--replay-from", "first", *options[:2])
    assert refused.process.wait(PATIENCE_S) == 1
    assert "first/replay: a learner writes to it; stop it first, or" in refused.text()
    assert first.end(signal.SIGINT) == 130
    events = [json.loads(x) for x in (tmp_path / "first/events.jsonl").read_text().splitlines()]
    assert [e["event"] for e in events if e["event"] in ("refusal", "leave")] == []
    assert directory.look_at(tmp_path / "first" / "replay").live.stop >= 100


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--replay-from", "nowhere"), "no learner at tcp/127.0.0.1"),
        (("--replay-from", "./nowhere"), "--replay-from: found no directory ./nowhere"),
        (("--replay-from", "."), "replay"),
        (("--replay-from", ".", "--evaluate-every", "9"), "which no evaluator can join"),
        (("--replay-from", "nowhere", "--variant", "on-policy"), "only --variant off-policy"),
    ],
)
def test_a_source_that_cannot_be_used_is_one_line(
    endpoint: str, arguments: tuple[str, ...], words: str
) -> None:
    options = ["--connect", endpoint, "--metrics-port", "-1"]
    done = CliRunner().invoke(app, ["learner", *arguments, *options])
    assert isinstance(done.exception, A2SError)
    assert words in str(done.exception)
    assert len(str(done.exception).splitlines()) == 1
