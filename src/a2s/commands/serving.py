"""Which port metrics are served on."""

from collections.abc import Callable
from typing import TypeVar

from a2s.protocol.errors import UsageError

Served = TypeVar("Served")


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
