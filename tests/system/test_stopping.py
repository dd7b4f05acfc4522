"""One signal ends a command with 128 and its number, wherever it meets it."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from system_helpers import FAST, PATIENCE_S, REACH, Command, Start

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
Moment = Callable[[Command], bool]
LONG = ("--episodes", "1000000")  # hours


def _train(start: Start, *options: str) -> Command:
    return start("train", *REACH, *FAST, "--run-dir", "run", "--metrics-port", "-1", *options)


def _part(train: Command, name: str) -> psutil.Process:
    """The ``learner`` or the ``actor`` of a training."""
    parts = psutil.Process(train.process.pid).children()
    return next(child for child in parts if name in child.cmdline())


def _learner(train: Command) -> list[str]:
    """What the learner of a training has mapped into its memory; nothing once it is gone."""
    with suppress(psutil.NoSuchProcess, StopIteration):
        return [m.path for m in _part(train, "learner").memory_maps()]
    return []


@pytest.mark.parametrize(
    ("moment", "number"),
    [
        (lambda train: "policy  " in train.text(), signal.SIGTERM),
        pytest.param(
            lambda train: "policy  " in train.text() and not _learner(train),
            signal.SIGINT,
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda train: "evaluating" in train.text(), signal.SIGTERM, marks=pytest.mark.long
        ),
    ],
    ids=["learner leaves", "actors leave", "evaluates"],
)
def test_a_training_whose_learner_is_done_ends(
    start: Start, tmp_path: Path, wait_for: WaitFor, moment: Moment, number: int
) -> None:
    train = _train(start, "--total-steps", "512", *LONG)
    wait_for(lambda: moment(train), "the moment", timeout_s=PATIENCE_S)
    assert train.end(number) == 128 + number, train.text()
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["finished"]
    _assert_quiet(train)


@pytest.mark.parametrize(
    ("name", "number", "code", "said"),
    [
        ("learner", signal.SIGTERM, 143, "stopped     go on with: a2s train --resume"),
        pytest.param(
            "actor",
            signal.SIGKILL,
            1,
            "a2s: process {pid} was ended by SIGKILL; the actors ended",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_training_one_of_whose_parts_is_ended_says_so(
    start: Start, tmp_path: Path, wait_for: WaitFor, name: str, number: int, code: int, said: str
) -> None:
    """A learner that is stopped by itself has the exit code of its signal, and no evaluation."""
    train = _train(start)
    began = tmp_path / "run" / "endpoint"
    wait_for(began.exists, "the training", timeout_s=PATIENCE_S)
    part = _part(train, name)
    part.send_signal(number)
    assert train.process.wait(PATIENCE_S) == code, train.text()
    assert said.format(pid=part.pid) in train.text()
    assert not json.loads((tmp_path / "run" / "summary.json").read_text())["finished"]


@pytest.mark.long
def test_ctrl_c_ends_an_evaluation_that_a_script_started_behind_itself(
    start: Start, wait_for: WaitFor
) -> None:
    """Shells have SIGINT ignored there."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        train = _train(start, "--total-steps", "512", *LONG)
    finally:
        signal.signal(signal.SIGINT, before)
    wait_for(lambda: "evaluating" in train.text(), "the evaluation", timeout_s=PATIENCE_S)
    assert train.end(signal.SIGINT) == 130, train.text()


@pytest.mark.parametrize(
    ("module", "number"),
    [pytest.param("", signal.SIGINT, marks=pytest.mark.long), ("libtorch", signal.SIGTERM)],
)
def test_a_training_whose_learner_starts_ends_and_leaves_no_trace_of_a_run_not_begun(
    start: Start,
    tmp_path: Path,
    wait_for: WaitFor,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    number: int,
) -> None:
    """Nor anything temporary, since a second Ctrl-C leaves no time to remove it."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    train = _train(start, "--total-steps", "512")
    wait_for(lambda: any(module in path for path in _learner(train)), "a learner that starts")
    assert not any(each.is_dir() for each in (tmp_path / "temporary").iterdir())
    assert train.end(number) == 128 + number, train.text()
    _assert_quiet(train)
    run = tmp_path / "run"
    assert run.exists() is (run / "config.toml").exists()


@pytest.mark.parametrize(
    "number", [signal.SIGHUP, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_learner_that_starts_ends(start: Start, wait_for: WaitFor, number: int) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # `nohup pytest` has it ignored
    try:
        learner = start("learner", *REACH, "--run-dir", "run", "--metrics-port", "-1")
    finally:
        signal.signal(number, before)
    maps = psutil.Process(learner.process.pid).memory_maps
    wait_for(lambda: any("libtorch" in m.path for m in maps()), "torch to be loaded")
    assert learner.end(number) == 128 + number, learner.text()
    _assert_quiet(learner)


@pytest.mark.parametrize("is_full", [pytest.param(True, marks=pytest.mark.long), False])
def test_a_run_outlasts_its_standard_output(tmp_path: Path, *, is_full: bool) -> None:
    """On a full disk, or when whoever read it is gone."""
    command = [
        sys.executable, "-P", "-m", "a2s.cli", "train", *REACH, *FAST, "--run-dir", "run",
        "--total-steps", "512", "--episodes", "1", "--metrics-port", "-1",
    ]  # fmt: skip
    reader, writer = os.pipe()
    os.close(reader)
    out = os.open("/dev/full", os.O_WRONLY) if is_full else writer
    done = subprocess.run(
        command, cwd=tmp_path, stdout=out, stderr=subprocess.PIPE, text=True, check=False,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["finished"]


def _assert_quiet(command: Command) -> None:
    assert "a2s: " not in command.text()
    assert "Traceback" not in command.text()
