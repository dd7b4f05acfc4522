"""Ends every process that a child has started, even if it changed its group or session.

A process keeps a variable of its environment unless somebody clears it. It belongs to the process
that started it; when that one ends, an ancestor inherits it.

Run as a file of its own this is the guard: a process that ends the remaining children of a parent
when the parent is killed. A child notices the end of its parent by itself, but the Python thread
that does so never runs while a call into an environment holds the interpreter. The guard imports
nothing of ours, so that it starts quickly.
"""

import atexit
import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable

FAMILY = "A2S_FAMILY"
_ROUNDS = 10
_GRACE_S = 15.0
_LOOK_EVERY_S = 0.2
_PR_SET_CHILD_SUBREAPER = 36


_before: set[int] | None = None  # children that were here first, of a shell that became us


def inherit_orphans() -> None:
    """Become the parent of every descendant whose own one ends."""
    global _before  # of the process, as what it is about
    if _before is None:
        _before = {pid for pid in _processes() if _is_orphan(pid)}
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def reap_orphans() -> None:
    """Wait for inherited processes that have ended; nothing else waits for them.

    A child of ours whose session is neither ours nor its own was not started by us.
    """
    with contextlib.suppress(ChildProcessError):  # there are no children
        if os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return  # none has ended
        for pid in _processes():
            if _is_orphan(pid) and _parent_and_session(pid)[1] != pid:
                os.waitpid(pid, os.WNOHANG)


def end_family(family: str, *, living: set[int]) -> None:
    """Kill the processes with the mark of a child, and the orphans that this process has inherited.

    Orphans are our children in another session than ours that we have not started. ``family`` is
    the value of `FAMILY` in the child's environment; ``living`` are children that we have started
    in sessions of their own.
    """
    for _ in range(_ROUNDS):
        others = _processes() - {os.getpid()} - living
        members = [p for p in others if _is_marked(p, f"{FAMILY}={family}") or _is_inherited(p)]
        if not members:
            return
        _kill(members)
        for pid in members:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)


def start_guard(mark: str) -> int:
    """Start a guard of this process, which ends with it, and give its process number.

    ``mark`` is the ``NAME=BEGINNING`` of a variable that all children have in their environment.
    """
    guard = subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, mark],
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


def _guard(mark: str) -> None:
    while sys.stdin.buffer.read(1):
        pass
    deadline_s = time.monotonic() + _GRACE_S
    while left := {pid for pid in _processes() if _is_marked(pid, mark)}:
        if time.monotonic() >= deadline_s:
            # First the processes that they have started, which may have no mark.
            parents = {pid: _parent_and_session(pid)[0] for pid in _processes()}
            found = set(left)
            while more := {p for p, parent in parents.items() if parent in found} - found:
                found |= more
            _kill([*sorted(found - left), *sorted(left)])
        time.sleep(_LOOK_EVERY_S)


def _kill(pids: Iterable[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def _processes() -> set[int]:
    return {int(name) for name in os.listdir("/proc") if name.isdigit()}


def _is_inherited(pid: int) -> bool:
    """Whether it is an orphan of a child's; the first process of a machine has all orphans."""
    return os.getpid() != 1 and pid not in (_before or ()) and _is_orphan(pid)


def _is_orphan(pid: int) -> bool:
    parent, session = _parent_and_session(pid)
    return parent == os.getpid() and session != os.getsid(0)


def _parent_and_session(pid: int) -> tuple[int, int]:
    with contextlib.suppress(OSError, IndexError, ValueError):
        with open(f"/proc/{pid}/stat", "rb") as file:
            _, parent, _, session = file.read().rpartition(b")")[2].split()[:4]
        return int(parent), int(session)
    return 0, 0


def _is_marked(pid: int, mark: str) -> bool:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
        return any(item.startswith(mark.encode()) for item in file.read().split(b"\0"))
    return False


if __name__ == "__main__":
    _guard(sys.argv[1])
