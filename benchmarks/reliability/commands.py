"""Real ``a2s`` commands of a trial: started, watched, and none left behind."""

import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil
from system_helpers import Command, is_alive

from a2s.commands.process import free_endpoint

_MARK = "RELIABILITY_TRIAL"
_CODE = "a2s_test_envs reliability.real_time"  # what actors of trials may run
_STEP_S = 0.01


class Commands:
    """Starts commands in a folder; at the end of the block all that still runs is killed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.endpoint = folder, free_endpoint()
        self._mark = uuid.uuid4().hex
        self._count = 0

    def __enter__(self) -> "Commands":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.left():
            with suppress(psutil.NoSuchProcess):
                process.kill()
                process.wait(5.0)

    def start(
        self,
        *arguments: str,
        environ: Mapping[str, str] = os.environ,
        within: Sequence[str] = (),
    ) -> Command:
        """Start ``a2s`` with these arguments; its words go into a log.

        ``within`` are words of a command that becomes it.
        """
        self._count += 1
        log = self.folder / f"{self._count}-{arguments[0]}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                [*within, sys.executable, "-P", "-m", "a2s.cli", *arguments],
                cwd=self.folder,
                env=self.marked(environ),
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        return Command(process, log)

    def marked(self, environ: Mapping[str, str] = os.environ) -> dict[str, str]:
        """An environment by which processes, and what they start, are found again."""
        return {"A2S_ALLOW_ENV": _CODE, **environ, _MARK: self._mark}

    def left(self) -> list[psutil.Process]:
        """What was started, by whomever, and is alive."""
        found, word = [], f"{_MARK}={self._mark}".encode()
        for place in Path("/proc").iterdir():
            if not place.name.isdecimal() or int(place.name) == os.getpid():
                continue
            try:
                environ = (place / "environ").read_bytes()
            except OSError:
                continue
            if word in environ.split(b"\0") and is_alive(int(place.name)):
                found.append(psutil.Process(int(place.name)))
        return found


def wait_for(condition: Callable[[], object], what: str, patience_s: float = 120.0) -> float:
    """Wait until something is true; gives how long that took, in seconds.

    Raises:
        TimeoutError: It did not become true.
    """
    begin_s = time.monotonic()
    while not condition():
        if time.monotonic() - begin_s > patience_s:
            raise TimeoutError(f"waited {patience_s:.0f} s for {what}")
        time.sleep(_STEP_S)
    return time.monotonic() - begin_s


def rows(table: Path) -> int:
    """Whole rows of a table below its header; 0 without one."""
    return max(0, table.read_bytes().count(b"\n") - 1) if table.exists() else 0
