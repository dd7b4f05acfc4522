"""Helper processes of an environment: they end with their worker, and keep nobody waiting."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from a2s_case_processes import KINDS
from case_runs import SMALL, a2s
from case_runs import train as train_to_the_end
from system_helpers import FAST, PATIENCE_S, Command, Start, is_alive

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
ENV = "a2s_case_processes:Helpers-v0"


@pytest.fixture
def notes(tmp_path: Path) -> Iterator[Path]:
    """Where the helpers are written down; those that are left in the end are killed."""
    path = tmp_path / "notes"
    path.touch()
    yield path
    for pid in _helpers(path):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _helpers(notes: Path) -> dict[int, str]:
    words = (line.split() for line in notes.read_text().splitlines())
    return {int(pid): kind for kind, pid in words}


def _living(notes: Path) -> dict[int, str]:
    return {pid: kind for pid, kind in _helpers(notes).items() if is_alive(pid)}


@pytest.fixture
def train(start: Start, tmp_path: Path, notes: Path, wait_for: WaitFor) -> Command:
    """A training of two workers with helpers that has made two updates."""
    train = start(
        "train", "--env", ENV, "--env-kwargs", f"notes={notes}", *FAST, "--n", "2",
        "--total-steps", "10000000", "--run-dir", "run", "--metrics-port", "-1",
    )  # fmt: skip
    updates = tmp_path / "run" / "updates.csv"
    wait_for(lambda: updates.exists() and updates.read_text().count("\n") > 2, "two updates")
    return train


def test_a_killed_worker_is_replaced_and_ctrl_c_stops_everything_cleanly(
    train: Command, tmp_path: Path, notes: Path, wait_for: WaitFor
) -> None:
    before, victim = _living(notes), train.workers()[0]
    assert set(before.values()) == {*KINDS}
    os.kill(victim.pid, signal.SIGKILL)
    wait_for(lambda: not is_alive(victim.pid), "the death of the worker")
    wait_for(lambda: len(train.workers()) == 2, "a replacement", timeout_s=5.0)
    gone = len(before) // 2
    wait_for(lambda: sum(map(is_alive, before)) == gone, "its helpers to end", timeout_s=10.0)
    wait_for(lambda: len(_living(notes)) == len(before), "new helpers")
    everyone = psutil.Process(train.process.pid).children(recursive=True)
    mine = psutil.Process().nice()
    assert all(worker.nice() > mine for worker in train.workers())
    assert train.end(signal.SIGINT) == 130, train.text()
    assert not any(is_alive(process.pid) for process in everyone)
    wait_for(lambda: _living(notes) == {}, f"the end of {_living(notes)}", timeout_s=5.0)
    assert "Traceback" not in train.text()
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["finished"] is False
    assert any((tmp_path / "run" / "checkpoints").iterdir())


def test_nobody_survives_a_killed_train(train: Command, notes: Path, wait_for: WaitFor) -> None:
    """Neither learner nor actors, nor what their environments have started."""
    everyone = psutil.Process(train.process.pid).children(recursive=True)
    assert len(everyone) >= 4
    train.process.kill()
    train.process.wait(PATIENCE_S)
    wait_for(lambda: not any(is_alive(p.pid) for p in everyone), "all to end", timeout_s=30.0)
    wait_for(lambda: _living(notes) == {}, "all helpers to end", timeout_s=30.0)


@pytest.mark.long
def test_nobody_waits_for_helpers_at_the_end_of_a_training_and_of_an_evaluation(
    tmp_path: Path, notes: Path
) -> None:
    trained = train_to_the_end(tmp_path, ENV, "--env-kwargs", f"notes={notes}", *SMALL)
    made = len(_helpers(notes))
    # The learner makes one environment, the actor two, and the evaluation two.
    assert made == 5 * len(KINDS)
    assert _living(notes) == {}
    assert trained.summary["wall_s"] < 60
    done = a2s("check", ENV, "--env-kwargs", f"notes={notes}", cwd=tmp_path)
    assert done.code == 0, done.err
    assert len(_helpers(notes)) > made
    assert _living(notes) == {}
