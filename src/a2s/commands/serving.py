"""Which ports are served on."""

import socket
from collections.abc import Callable
from typing import TypeVar

from a2s.protocol.errors import UsageError

Served = TypeVar("Served")


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
