"""The writes of a process, with faults: a disk that is full, or a kill in the middle of the nth.

Processes that are started with `Faults.environ` count their writes below a folder together, in a
file that they map; `Faults.arm` says there what is to happen. ``faults.c`` does it.
"""

import os
import struct
import subprocess
import sys
from enum import IntEnum
from pathlib import Path

_STATE = struct.Struct("<3q104s")
_SOURCE = Path(__file__).with_name("faults.c")


class Fault(IntEnum):
    """What happens at a write: nothing; no space, once or from there on; SIGKILL halfway."""

    NOTHING, FULL_ONCE, FULL_FROM_THERE, KILL = range(4)


class Faults:
    """The writes below ``folder / "faulty"``; the folder itself has what they are counted with."""

    def __init__(self, folder: Path) -> None:
        self.place = folder.resolve() / "faulty"
        self.place.mkdir(parents=True, exist_ok=True)
        self._library, self._state = folder.resolve() / "faults.so", folder.resolve() / "faults"
        self.log = folder.resolve() / "writes.log"
        if not self._library.exists():
            command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(self._library), str(_SOURCE)]
            subprocess.run([*command, "-ldl"], check=True)
            self.arm(Fault.NOTHING)

    def environ(self, *, logged: bool = False) -> dict[str, str]:
        """The environment in which a process has these faults; ``logged``: it lists its writes."""
        return {
            **os.environ,
            "LD_PRELOAD": str(self._library),
            "FAULTS_DIR": str(self.place),
            "FAULTS_STATE": str(self._state),
            "FAULTS_LOG": str(self.log) if logged else "",
        }

    def arm(self, fault: Fault, at: int = 0, match: str = "") -> None:
        """Count from 0, only paths with ``match`` in them, to a fault at the ``at``-th write."""
        state = _STATE.pack(0, at, fault, match.encode())
        with open(os.open(self._state, os.O_RDWR | os.O_CREAT, 0o644), "r+b") as file:
            file.write(state)

    def count(self) -> int:
        """Writes so far."""
        found: int = _STATE.unpack(self._state.read_bytes())[0]
        return found

    def forget(self) -> None:
        """Begin the list of writes anew."""
        self.log.write_text("")  # not deleted: processes have it open

    def writes(self) -> list[str]:
        """What was written, each as operation and path."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [line.split(" ", 1)[1] for line in lines]

    def enter(self, module: str, *, logged: bool = False) -> None:
        """Run this program in a process with these faults, unless this is one."""
        if os.environ.get("FAULTS_STATE") != str(self._state):
            environ = self.environ(logged=logged) | {"RELIABILITY_FOLDER": str(self._state.parent)}
            command = [sys.executable, "-m", module, *sys.argv[1:]]
            sys.exit(subprocess.run(command, env=environ, check=False).returncode)
