"""Where each role spends its time: ``python -m speed.flames``: a flame graph of each.

A run of the defaults of each variant is looked at by py-spy, from its third update on, while it
goes on. The pictures are written beside this file.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent / "flames"
ENV_ID, SECONDS, RATE, PATIENCE_S = "HalfCheetah-v5", 10, 200, 300.0
ROLES = {"learner": "a2s.start learner", "actor": "a2s.actors.worker"}
RUNS: dict[str, tuple[str, ...]] = {
    "on-policy": (),
    "off-policy": ("--variant", "off-policy", "--set", "warm_up_steps=1000"),
}
ENDLESS = str(10**9)


def look(name: str, options: tuple[str, ...]) -> None:
    """Train until there is a picture of each role."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        command = (
            sys.executable, "-m", "a2s.cli", "train", "--env", ENV_ID, "--run-dir", str(path),
            "--total-steps", ENDLESS, "--metrics-port", "-1", *options,
        )  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as training:
            try:
                _wait(training, path / "updates.csv")
                spies = [_spy(_process(training.pid, words), f"{name}-{role}")
                         for role, words in ROLES.items()]  # fmt: skip
                if any(spy.wait() for spy in spies):
                    sys.exit("py-spy could not look: see above why")
            finally:
                training.terminate()


def _wait(training: "subprocess.Popen[bytes]", updates: Path) -> None:
    """Wait for the third update."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not updates.exists() or len(updates.read_text().splitlines()) < 4:
        if training.poll() is not None or time.monotonic() > give_up_s:
            sys.exit(f"{' '.join(map(str, training.args))}: made no third update")  # type: ignore[arg-type]
        time.sleep(0.1)


def _process(root: int, words: str) -> int:
    """The first process under one whose command has these words."""
    return next(pid for pid in _below(root) if words in _command(pid))


def _below(pid: int) -> Iterator[int]:
    for child in map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()):
        yield child
        yield from _below(child)


def _command(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()


def _spy(pid: int, name: str) -> "subprocess.Popen[bytes]":
    spy = Path(sys.executable).with_name("py-spy")
    words = (
        "py-spy", "record", "--pid", str(pid), "--duration", str(SECONDS), "--rate", str(RATE),
        "--threads", "--output", f"{name}.svg",
    )  # fmt: skip
    return subprocess.Popen(words, executable=spy, cwd=HERE)  # the picture names the command


def main() -> None:
    """Draw all of them."""
    HERE.mkdir(exist_ok=True)
    for name, options in RUNS.items():
        look(name, options)
    sys.stdout.write(f"{HERE}\n")


if __name__ == "__main__":
    main()
