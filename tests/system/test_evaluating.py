"""Evaluation while training, with real processes."""

import csv
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from system_helpers import FAST, PATIENCE_S, REACH, Command, Start

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
EVALUATED = ("--evaluate-every", "512", "--evaluation-episodes", "3")
OFF = ("--metrics-port", "-1")


def _rows(run: Path) -> list[dict[str, str]]:
    table = run / "evaluations.csv"
    if not table.exists():
        return []
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_is_the_same_to_the_bit_with_and_without_evaluations(
    run_a2s: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    """And what is evaluated is there when it ends, also of its last weights."""
    same = ("train", *REACH, *FAST, *OFF, "--total-steps", "1024", "--episodes", "1")
    alone = run_a2s(*same, "--run-dir", "alone")
    seen = run_a2s(*same, *EVALUATED, "--run-dir", "seen")
    assert seen["weights_sha256"] == alone["weights_sha256"]
    found = [(int(row["env_steps"]), row["mode"]) for row in _rows(tmp_path / "seen")]
    assert found == [(s, mode) for s in (512, 1024) for mode in ("mean", "best-of-k")]
    means = [float(row["return_mean"]) for row in _rows(tmp_path / "seen")]
    assert seen["evaluation_best"]["mean"] == pytest.approx(max(means[::2]))
    assert (tmp_path / "seen" / "best" / "policy.onnx").exists()


@pytest.mark.long
def test_an_evaluator_joins_late_and_is_replaced_when_it_dies(
    start: Start, tmp_path: Path, wait_for: WaitFor, endpoint: str
) -> None:
    """The run goes on meanwhile, and ends when an evaluation is as good as was wanted."""
    run, there = tmp_path / "run", ("--connect", endpoint, *OFF)
    learner = start(
        "learner", *REACH, *FAST, *OFF, *EVALUATED, "--total-steps", "1000000000",
        "--stop-at-return", "-1e9", "--listen", endpoint, "--run-dir", "run",
    )  # fmt: skip
    actors = start("actor", *there)
    wait_for(lambda: len(_updates(run)) > 5, "updates", timeout_s=PATIENCE_S)
    assert not (run / "evaluations.csv").exists()

    evaluator = start("actor", "--evaluate", *there)
    _kill_at_once(evaluator, wait_for)
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    assert json.loads((run / "summary.json").read_text())["finished"]
    assert [row["mode"] for row in _rows(run)][:2] == ["mean", "best-of-k"]
    assert "worker 0 is replaced" in evaluator.text()
    said = (
        "run 'default' has ended: an evaluation was good enough; waiting for a learner that goes on"
    )
    for command in (actors, evaluator):
        wait_for(lambda c=command: said in c.text(), "word of the end")
        assert command.end() == 143, command.text()


def _updates(run: Path) -> list[str]:
    table = run / "updates.csv"
    return table.read_text().splitlines() if table.exists() else []


def _kill_at_once(evaluator: Command, wait_for: WaitFor) -> None:
    """Kill the worker of an evaluator as soon as there is one."""
    wait_for(lambda: bool(evaluator.workers()), "an evaluator", timeout_s=PATIENCE_S)
    evaluator.workers()[0].send_signal(signal.SIGKILL)
