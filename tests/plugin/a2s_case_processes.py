"""Environments that do something to the process around them; importing registers them.

They print, start helpers that live on, hang, want to be alone, and cannot be closed.
"""

import argparse
import ctypes
import fcntl
import logging.config
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from a2s_case_envs import Control, Obs, Step, register

AGES_S = 600.0  # longer than any test waits

print("a word of the import")  # noqa: T201


class Noisy(Control):
    """Prints in every way, all the time, and nothing else is different."""

    def __init__(self) -> None:
        super().__init__()
        self._steps = 0
        print("a word of the constructor")  # noqa: T201

    def begin(self) -> Obs:
        print("an episode begins", flush=True)  # noqa: T201
        return super().begin()

    def step(self, action: Obs) -> Step:
        self._steps += 1
        print(f"step {self._steps}")  # noqa: T201
        if self._steps % 40 == 0:
            _WAYS[self._steps // 40 % len(_WAYS)]()
        return super().step(action)

    def close(self) -> None:
        print("a word of the end")  # noqa: T201


def _print(words: str, end: str = "\n") -> Callable[[], None]:
    return lambda: print(words, end=end, flush=True)  # noqa: T201


def _write(descriptor: int, data: bytes) -> Callable[[], None]:
    def write() -> None:
        os.write(descriptor, data)

    return write


def _child() -> None:
    subprocess.run(["echo", "a word of a child"], check=True)


_WAYS: tuple[Callable[[], None], ...] = (
    _write(1, b"a word of C\n"),
    _write(2, b"a word of the error output\n"),
    _write(1, b"\xff\xfe is not \xc3\x28 text\n"),
    _write(1, b"zero \x00 and \x1b[31m colour\n"),
    _child,
    _print('{"counters": {"env_steps": {"": 5}}, "gauges": {}}'),
    _print("[1, 2]"),
    _print("null"),
    _print("no end of a line", end=""),
    _print("10 %\r20 %", end="\r"),
    _write(1, b"x" * 60_000),
    _print("y" * 100_000 + "\nafter a long line"),
)
STEPS_OF_ALL_WAYS = 40 * len(_WAYS)


class Helpers(Control):
    """Starts processes that live on: see `KINDS`.

    Args:
        notes: File to which a line is added for each: its kind and its number.
    """

    def __init__(self, notes: str) -> None:
        super().__init__()
        for kind, helper in KINDS.items():
            with Path(notes).open("a") as file:
                file.write(f"{kind} {helper()}\n")


def _plain() -> int:
    return subprocess.Popen(["sleep", str(AGES_S)]).pid


def _session() -> int:
    return subprocess.Popen(["sleep", str(AGES_S)], start_new_session=True).pid


def _fork() -> int:
    """Everything that is open is open in the child too, and Python waits for it at its end."""
    child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(AGES_S,))
    child.start()
    assert child.pid is not None
    return child.pid


def _deaf() -> int:
    """It does not end when it is asked to."""
    code = f"import signal, time; signal.signal(15, signal.SIG_IGN); time.sleep({AGES_S})"
    return subprocess.Popen([sys.executable, "-c", code]).pid


def _bare() -> int:
    """It inherits no variable by which it could be known."""
    return subprocess.Popen(["sleep", str(AGES_S)], env={}, start_new_session=True).pid


KINDS = {"plain": _plain, "session": _session, "fork": _fork, "deaf": _deaf, "bare": _bare}


class Hangs(Control):
    """Does what is planned, each thing once, by whoever comes to it first.

    Args:
        notes: Directory that says what was done.
        plan: Of `DEEDS`, with commas; ``step-``: in the 30th step, ``reset-``: in the second
            reset.
    """

    def __init__(self, notes: str, plan: str) -> None:
        super().__init__()
        self._notes, self._plan, self._steps = Path(notes), plan.split(","), 0

    def _do(self, where: str) -> None:
        for item in self._plan:
            if not item.startswith(where):
                continue
            try:
                os.close(os.open(self._notes / item, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            DEEDS[item]()
            return

    def begin(self) -> Obs:
        if self._steps:
            self._do("reset-")
        return super().begin()

    def step(self, action: Obs) -> Step:
        self._steps += 1
        if self._steps == 30:
            self._do("step-")
        return super().step(action)


DEEDS: dict[str, Callable[[], object]] = {
    "step-sleeps": lambda: time.sleep(AGES_S),
    # No thread of Python runs meanwhile.
    "step-holds-the-lock": lambda: ctypes.PyDLL(None).sleep(int(AGES_S)),
    "step-aborts": os.abort,
    "step-raises": lambda: 1 / 0,
    "reset-sleeps": lambda: time.sleep(AGES_S),
}  # fmt: skip


class Doomed(Control):
    """Of one worker every step aborts, once it has made 400.

    Args:
        worker: Number of the worker.
        doomed: Number of the one that aborts.
        notes: Directory that says whether it has.
    """

    def __init__(self, worker: int, doomed: int, notes: str) -> None:
        super().__init__()
        self._note, self._steps = Path(notes) / "doomed", 0
        self._is_doomed = worker == doomed

    def step(self, action: Obs) -> Step:
        self._steps += 1
        if self._is_doomed and (self._steps == 400 or self._note.exists()):
            self._note.touch()
            os.abort()
        return super().step(action)


class HangsAlways(Control):
    """Never returns from where it is told."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self._where = where
        self._hang("make")

    def _hang(self, where: str) -> None:
        if where == self._where:
            time.sleep(AGES_S)

    def begin(self) -> Obs:
        self._hang("reset")
        return super().begin()

    def close(self) -> None:
        self._hang("close")
        if self._where == "raise in close":
            raise RuntimeError("there is nothing to close")
        if self._where == "exit in close":
            sys.exit(3)


class Places(Control):
    """There are so many places for it on this machine, and it holds one until its process ends.

    Args:
        notes: Directory of the places.
        places: How many.
    """

    def __init__(self, notes: str, places: int) -> None:
        super().__init__()
        for index in range(places):
            place = (Path(notes) / f"place-{index}").open("w")
            try:
                fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                place.close()
                continue
            _HELD.append(place)
            return
        raise RuntimeError(f"all {places} places are taken")


_HELD: list[object] = []


class Spoils(Control):
    """Changes what belongs to the whole process in its tenth step, goes on, and says why it ends.

    Args:
        how: Of `SPOILED`.
    """

    def __init__(self, how: str) -> None:
        super().__init__(scale=1e-60, dtype="float64")  # float32 has no such numbers
        self._how, self._steps = how, 0

    def step(self, action: Obs) -> Step:
        self._steps += 1
        if self._steps == 10:
            SPOILED[self._how]()
        if self._steps == 20:
            raise RuntimeError("here is why \udc80\x1b[31m" + 1000 * "!")
        return super().step(action)


def _close_the_streams() -> None:
    sys.stdout.close()
    sys.stderr.close()


def _leave_the_directory() -> None:
    place = tempfile.mkdtemp()
    os.chdir(place)
    os.rmdir(place)


def _stop_the_clock() -> None:
    vars(time).update(monotonic=lambda: "late", perf_counter=lambda: "later")


SPOILED: dict[str, Callable[[], object]] = {
    "closes the streams": _close_the_streams,
    "has no streams": lambda: vars(sys).update(stdout=None, stderr=None),
    "closes descriptors 1 and 2": lambda: os.closerange(1, 3),
    "makes errors of numbers": lambda: np.seterr(all="raise"),
    "makes errors of warnings": lambda: warnings.simplefilter("error"),
    "leaves the directory": _leave_the_directory,
    "stops the clock": _stop_the_clock,
    "closes all descriptors": lambda: os.closerange(3, 1000),
}


class SilencesLogs(Control):
    """Configures ``logging`` as if the process were its own, and fails in close."""

    def __init__(self) -> None:
        super().__init__()
        logging.config.dictConfig({"version": 1})  # disables all loggers there are
        logging.basicConfig(handlers=[], level=logging.CRITICAL, force=True)
        logging.disable(logging.CRITICAL)

    def close(self) -> None:
        raise RuntimeError("there is nothing to close")


class Daemons(Control):
    """Starts processes that end at once, and whose parents have ended before them.

    It prints how many of them are zombies a while later.
    """

    def __init__(self) -> None:
        super().__init__()
        for _ in range(3):
            code = "import os; os.setsid(); os.fork() and os._exit(0); os._exit(0)"
            subprocess.run([sys.executable, "-c", code], check=True)
        time.sleep(2.5)
        children = psutil.Process().children()
        print(f"{sum(c.status() == psutil.STATUS_ZOMBIE for c in children)} zombies")  # noqa: T201


class Forks(Control):
    """Copies its process in the constructor and in steps; a copy ends by an exception."""

    def __init__(self) -> None:
        super().__init__()
        self._copy(SystemExit(0))

    def _copy(self, end: BaseException) -> None:
        pid = os.fork()
        if pid == 0:
            raise end
        os.waitpid(pid, 0)

    def step(self, action: Obs) -> Step:
        step = super().step(action)
        if self.at == 3:
            self._copy(RuntimeError("in a copy"))
        return step


class ReadsArguments(Control):
    """Believes that the command line is its own."""

    def __init__(self) -> None:
        super().__init__()
        argparse.ArgumentParser().parse_args()


class SlowResets(Control):
    """Each takes a while, and all of them together longer than one may."""

    def begin(self) -> Obs:
        time.sleep(0.15)
        return super().begin()


class Flood(Control):
    """Prints a thousand lines in each step."""

    def step(self, action: Obs) -> Step:
        print("a flood\n" * 1000)  # noqa: T201
        return super().step(action)


for _class in (
    Noisy, Helpers, Hangs, Doomed, HangsAlways, Places, Spoils, SilencesLogs, Daemons, Forks,
    ReadsArguments, SlowResets, Flood,
):  # fmt: skip
    register(_class.__name__, _class)
register("CloseRaises", HangsAlways, where="raise in close")
register("CloseExits", HangsAlways, where="exit in close")
