"""One learner in two processes of torchrun: it learns what one process learns, and ends with it."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from replay_oracle import ENV_ID, SPACES, make_segment
from system_helpers import PATIENCE_S, Command

from a2s.learner.replay import directory

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

Launch = Callable[..., Command]
SMALL = (
    "--set", "critic_sizes=16,16", "--set", "policy_sizes=16,16", "--set", "batch_rows=16",
    "--replay-from", "first", "--metrics-port", "-1", "--run-dir",
)  # fmt: skip
TORCHRUN = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "--")


@pytest.fixture
def launch(tmp_path: Path) -> Launch:
    """Start ``a2s learner`` from a small replay, within torchrun or not."""
    replay = directory.create(tmp_path / "first", ENV_ID, SPACES, 100)
    for seq in range(10):
        obs = [0.1 * number for number in range(9)]
        replay.insert(make_segment(obs, [1.0] * 8, seq=seq, end="truncated"))
    replay.close()

    def begin(*before: str, run: str, steps: int, more: tuple[str, ...] = ()) -> Command:
        log = tmp_path / f"{run}-{steps}.log"
        command = ("-m", *before, "a2s", "learner", *SMALL, run, "--total-steps", str(steps))
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, *command, *more],
                cwd=tmp_path,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
        return Command(process, log)

    return begin


def learned(run: Path) -> bytes:
    """Everything that the newest checkpoint of a run has learned."""
    return (max((run / "checkpoints").iterdir()) / "tensors.safetensors").read_bytes()


def test_it_learns_what_one_process_learns(launch: Launch, tmp_path: Path) -> None:
    """To the bit."""
    for each in (launch(run="one", steps=100), launch(*TORCHRUN, run="two", steps=100)):
        assert each.process.wait(PATIENCE_S) == 0, each.text()
    assert learned(tmp_path / "two") == learned(tmp_path / "one")


@pytest.mark.long
def test_each_goes_on_with_a_run_of_the_other(launch: Launch, tmp_path: Path) -> None:
    """As if nothing had been."""
    one = launch(run="one", steps=200)
    for before, steps in ((TORCHRUN, 100), ((), 150), (TORCHRUN, 200)):
        more = ("--resume",) if steps > 100 else ()
        two = launch(*before, run="two", steps=steps, more=more)
        assert two.process.wait(PATIENCE_S) == 0, two.text()
    assert one.process.wait(PATIENCE_S) == 0, one.text()
    assert learned(tmp_path / "two") == learned(tmp_path / "one")


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_both_with_a_whole_checkpoint(
    launch: Launch, tmp_path: Path, number: int
) -> None:
    """Also of torchrun, which sends it on."""
    two = launch(*TORCHRUN, run="two", steps=10**7)
    wait_until_learning(two)
    children = psutil.Process(two.process.pid).children(recursive=True)
    two.end(number)
    psutil.wait_procs(children, PATIENCE_S)
    assert "gradient steps in" in two.text()
    assert "is gone" not in two.text()
    made = int(max((tmp_path / "two" / "checkpoints").iterdir()).name)
    assert made > 0
    again = launch(run="two", steps=made + 10, more=("--resume",))
    assert again.process.wait(PATIENCE_S) == 0, again.text()


@pytest.mark.long
@pytest.mark.parametrize("killed", [0, 1])
def test_a_process_that_dies_takes_the_other_along_in_one_line(launch: Launch, killed: int) -> None:
    """Whichever it is."""
    two = launch(*TORCHRUN, run="two", steps=10**7)
    wait_until_learning(two)
    by_rank = {p.environ()["RANK"]: p for p in psutil.Process(two.process.pid).children()}
    by_rank[str(killed)].kill()
    assert two.process.wait(PATIENCE_S) != 0
    said = [line for line in two.text().splitlines() if line.startswith("a2s: ")]
    assert len(said) <= 1  # torchrun may be quicker
    assert all("another process of torchrun is gone" in line for line in said)


def wait_until_learning(command: Command) -> None:
    """Wait for the first line of progress."""
    pause = threading.Event()
    while "steps=" not in command.text():
        assert command.process.poll() is None, command.text()
        pause.wait(0.05)
