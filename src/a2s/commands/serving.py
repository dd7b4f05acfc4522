"""Which ports are served on, and where what others say is passed on to."""

import contextlib
import os
import socket
import sys
from collections.abc import Callable
from typing import TypeVar

from a2s.protocol.errors import UsageError

Served = TypeVar("Served")
_STANDARD_ERROR = 2


def pass_on(line: str) -> None:
    """Pass on what an environment says, if anybody still reads it."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"{'' if line.startswith('environment ') else 'environment: '}{line}\n")


def fill_standard_streams() -> None:
    """Open those that were closed before this process began: pipes would take their numbers."""
    fd = os.open(os.devnull, os.O_RDWR)
    while fd <= _STANDARD_ERROR:
        fd = os.open(os.devnull, os.O_RDWR)
    os.close(fd)
    for number, name in ((1, "stdout"), (_STANDARD_ERROR, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def free_endpoint() -> str:
    """Name an endpoint on this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def serve_on(port: int | None, usual: int, serve: Callable[[int], Served]) -> Served:
    """Serve on the port the user names; else on the usual one, or any where that is taken.

    Raises:
        UsageError: The port the user names is taken.
    """
    if port is not None:
        return serve(port)
    try:
        return serve(usual)
    except UsageError:
        return serve(0)
