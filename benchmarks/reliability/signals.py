"""Signals to ``a2s train`` at random moments, from its very first millisecond.

``python -m reliability.signals --count 200``. In turn: Ctrl-C, SIGTERM, SIGHUP, Ctrl-C twice, and a
terminal that is closed. A process that a signal ends before Python runs has the same exit code in a
shell.
"""

import argparse
import fcntl
import os
import pty
import random
import shutil
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path

from reliability.commands import Commands, wait_for
from reliability.run_files import not_whole
from reliability.trial import Result, folder, tell
from system_helpers import FAST, OFF_POLICY, REACH

KINDS = {
    "Ctrl-C": signal.SIGINT,
    "SIGTERM": signal.SIGTERM,
    "SIGHUP": signal.SIGHUP,
    "Ctrl-C twice": signal.SIGINT,
    "terminal closed": signal.SIGHUP,
}
VARIANTS = ((*FAST,), (*OFF_POLICY, "--set", "warm_up_steps=100"))
_WITHIN_S = 10.0


class Training:
    """An ``a2s train``, with a terminal of its own if that will be closed."""

    def __init__(self, commands: Commands, path: Path, *options: str, has_terminal: bool) -> None:
        self.log, self._master = commands.folder / "train.log", -1
        arguments = ("train", *REACH, *options, "--total-steps", "100000000")
        command = [sys.executable, "-P", "-m", "a2s.start", *arguments, "--run-dir", str(path)]
        out = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        if has_terminal:
            self._master, slave = pty.openpty()
            threading.Thread(target=_copy, args=(os.dup(self._master), out), daemon=True).start()
        self.process = subprocess.Popen(
            [*command, "--metrics-port", "-1"],
            cwd=commands.folder,
            env=commands.marked(),
            stdin=slave if has_terminal else subprocess.DEVNULL,
            stdout=slave if has_terminal else out,
            stderr=slave if has_terminal else out,
            start_new_session=True,
            preexec_fn=_take_terminal if has_terminal else _default_signals,
        )
        os.close(slave if has_terminal else out)

    def close_terminal(self) -> None:
        """Close both ends that are ours."""
        os.close(self._master)
        _CLOSED.set()


_CLOSED = threading.Event()


def _copy(master: int, log: int) -> None:
    """Copy what a terminal shows, until it is to be closed."""
    os.set_blocking(master, False)
    while not _CLOSED.wait(0.01):
        with suppress(OSError):
            os.write(log, os.read(master, 1 << 16))
    os.close(master)
    os.close(log)


def _default_signals() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):  # nohup, and shells behind themselves, ignore
        signal.signal(number, signal.SIG_DFL)


def _take_terminal() -> None:
    _default_signals()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def once(kind: str, moment_s: float, second_s: float, options: tuple[str, ...], place: Path) -> str:
    """One training; says what does not hold."""
    path, number = place / "run", KINDS[kind]
    shutil.rmtree(path, ignore_errors=True)
    _CLOSED.clear()
    with Commands(place) as commands:
        train = Training(commands, path, *options, has_terminal=kind == "terminal closed")
        time.sleep(moment_s)
        begin_s = time.monotonic()
        if kind == "terminal closed":
            train.close_terminal()
        else:
            train.process.send_signal(number)
        if kind == "Ctrl-C twice":
            time.sleep(second_s)
            train.process.send_signal(number)
        try:
            code = train.process.wait(60.0)
        except subprocess.TimeoutExpired:
            return f"hangs; {_orphans(commands, 0.0)}; said {train.log.read_text()[-300:]!r}"
        took_s = time.monotonic() - begin_s
        words = train.log.read_text(errors="replace")
        wrong = [_orphans(commands, max(0.0, _WITHIN_S - took_s))]
    # Before Python has come to a2s, it has its own words and codes.
    is_ours = "a2s" in words or not words.startswith(("Traceback", "Fatal Python error: init"))
    if is_ours and code not in (128 + number, -number):
        wrong.append(f"exit code {code}")
    if took_s > _WITHIN_S:
        wrong.append(f"ended after {took_s:.1f} s")
    if is_ours and "Traceback" in words:
        wrong.append(f"a traceback, last: {words.strip().splitlines()[-1]}")
    if kind != "Ctrl-C twice" or (path / "config.toml").exists():
        wrong.append(not_whole(path))
    return "; ".join(filter(None, wrong))


def _orphans(commands: Commands, patience_s: float) -> str:
    """What has not ended in the same time: after a second signal nobody waits for the learner."""
    try:
        wait_for(lambda: not commands.left(), "the end of all", patience_s)
    except TimeoutError:
        names = [" ".join(each.cmdline()[:6]) for each in commands.left()]
        return f"left: {', '.join(names)}" if names else ""
    return ""


def main() -> None:
    """Parse, send, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument(
        "--span", type=float, default=30.0, help="seconds; early moments are likelier"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    result = Result(
        "signals to a2s train",
        "exit code 130, 143 or 129 within 10 s; whole or not begun; no orphan, no traceback",
    )
    rng = random.Random(options.seed)
    with folder() as place:
        for number in range(options.count):
            kind = list(KINDS)[number % len(KINDS)]
            moment_s, second_s = options.span * rng.random() ** 3, rng.random()
            variant = VARIANTS[number // len(KINDS) % len(VARIANTS)]
            of = f"{kind} after {moment_s:.3f} s"
            result.add(once(kind, moment_s, second_s, variant, place), of=of)
    tell([result])


if __name__ == "__main__":
    main()
