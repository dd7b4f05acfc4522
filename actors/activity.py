"""The call into an environment that a process is in, on a page of memory its parent can read.

A call that never returns may also hold the interpreter, so the process cannot be asked.
"""

import mmap
import os
from time import monotonic  # as it was before a user's code could replace it
from typing import Literal, NamedTuple, get_args

Call = Literal["make", "reset", "step", "close", "render"]
_CALLS: tuple[Call, ...] = get_args(Call)
MAKE, RESET, STEP, CLOSE, RENDER = 1, 2, 3, 4, 5
_WIDTH = 8  # of a call's number in the sum of call and environment


class Doing(NamedTuple):
    """A call into an environment that has not returned."""

    call: Call
    env_index: int
    since_s: float

    def __str__(self) -> str:
        """Describe the call for a user."""
        return f"{self.call} of environment {self.env_index} for {self.since_s:.0f} s"


class Activity:
    """The page: when the present call began, and which it is.

    ``fd`` is the descriptor of a page from `share`; with ``None`` nobody else reads the page.
    """

    def __init__(self, fd: int | None = None) -> None:
        buffer = bytearray(mmap.PAGESIZE) if fd is None else mmap.mmap(fd, mmap.PAGESIZE)
        self._page = memoryview(buffer).cast("d")

    def begin(self, call: int, env_index: int) -> None:
        """Note that a call begins: one of the numbers above."""
        self._page[0] = monotonic()
        self._page[1] = call + _WIDTH * env_index

    def end(self) -> None:
        """Note that it has returned."""
        self._page[1] = 0.0

    def now(self) -> Doing | None:
        """Read the present call, if there is one."""
        begun_s, which = self._page[0], int(self._page[1])
        if not which:
            return None
        env_index, call = divmod(which, _WIDTH)
        return Doing(_CALLS[call - 1], env_index, max(0.0, monotonic() - begun_s))


def share() -> int:
    """Make a page that processes can share, and give its file descriptor."""
    fd = os.memfd_create("a2s-activity")
    os.ftruncate(fd, mmap.PAGESIZE)
    return fd
