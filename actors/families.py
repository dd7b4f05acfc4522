"""Ending all that a child process has started, whatever it has made of itself.

A process keeps a variable of its environment unless somebody clears it, and belongs to whoever
started it, or inherits it when that one ends; a process group and a session it may leave.
"""

import contextlib
import ctypes
import os
import signal

FAMILY = "A2S_FAMILY"
_ROUNDS = 10
_PR_SET_CHILD_SUBREAPER = 36


_before: set[int] | None = None  # children that were here first, of a shell that became us


def inherit_orphans() -> None:
    """Become the parent of every descendant whose own one ends."""
    global _before  # of the process, as what it is about
    if _before is None:
        _before = {pid for pid in _processes() if _is_orphan(pid)}
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_family(family: str, *, living: set[int]) -> None:
    """Kill what carries the mark of a child, and the orphans that this process has inherited.

    Orphans are our children in another session than ours that we have not started.

    Args:
        family: Value of `FAMILY` in the child's environment.
        living: Children that we have started in sessions of their own.
    """
    mark = f"{FAMILY}={family}".encode()
    for _ in range(_ROUNDS):
        others = _processes() - {os.getpid()} - living
        members = [p for p in others if mark in _environment(p) or _is_inherited(p)]
        if not members:
            return
        for pid in members:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)


def _processes() -> set[int]:
    return {int(name) for name in os.listdir("/proc") if name.isdigit()}


def _is_inherited(pid: int) -> bool:
    """Whether it is an orphan of a child's; the first process of a machine has all orphans."""
    return os.getpid() != 1 and pid not in (_before or ()) and _is_orphan(pid)


def _is_orphan(pid: int) -> bool:
    with contextlib.suppress(OSError, IndexError, ValueError):
        with open(f"/proc/{pid}/stat", "rb") as file:
            _, parent, _, session = file.read().rpartition(b")")[2].split()[:4]
        return int(parent) == os.getpid() and int(session) != os.getsid(0)
    return False


def _environment(pid: int) -> list[bytes]:
    try:
        with open(f"/proc/{pid}/environ", "rb") as file:
            return file.read().split(b"\0")
    except OSError:
        return []
