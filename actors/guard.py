"""A process that ends what is left of a parent's children when the parent is killed.

A child sees the end of its parent by itself, but a thread of Python that does so never runs while a
call into an environment holds the interpreter.

Run as a file of its own: it imports nothing of ours, and starts in a moment.
"""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

_GRACE_S = 15.0
_LOOK_EVERY_S = 0.2


def start_guard(mark: str) -> int:
    """Start one for this process; it ends with it.

    Args:
        mark: ``NAME=BEGINNING`` of a variable that all children have in their environment.

    Returns:
        Its process number.
    """
    command = [sys.executable, "-I", "-S", __file__, mark]
    guard = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,  # nothing is ever written: its end is ours
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )

    def end() -> None:
        guard.kill()
        guard.wait()

    atexit.register(end)
    return guard.pid


def _await_parent(mark: str) -> None:
    while sys.stdin.buffer.read(1):
        pass
    deadline_s = time.monotonic() + _GRACE_S
    while left := set(_marked(mark.encode())):
        if time.monotonic() >= deadline_s:
            _kill(left)
        time.sleep(_LOOK_EVERY_S)


def _kill(left: set[int]) -> None:
    """Kill them, and first what they have started, which may bear no mark."""
    parents = {pid: _parent(pid) for pid in _processes()}
    found = set(left)
    while more := {p for p, parent in parents.items() if parent in found} - found:
        found |= more
    for pid in sorted(found - left) + sorted(left):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def _processes() -> Iterator[int]:
    return (int(name) for name in os.listdir("/proc") if name.isdigit())


def _parent(pid: int) -> int:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/stat", "rb") as file:
        return int(file.read().rpartition(b")")[2].split()[1])
    return 0


def _marked(mark: bytes) -> Iterator[int]:
    for pid in _processes():
        with contextlib.suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
            if any(item.startswith(mark) for item in file.read().split(b"\0")):
                yield pid


if __name__ == "__main__":
    _await_parent(sys.argv[1])
