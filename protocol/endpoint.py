"""Where a learner listens, as its user writes it, and where it is reached from its machine."""

import re

from a2s.protocol.errors import UsageError

_ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/[^/?#]+:(?P<port>\d{1,5})|unixsock-stream/.+")


def check_endpoint(endpoint: str) -> None:
    """Raise UsageError unless the endpoint is of the form PROTOCOL/HOST:PORT."""
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or not 0 < int(found["port"] or 1) < 1 << 16:
        raise UsageError(
            f"endpoint: found {endpoint!r}, expected PROTOCOL/HOST:PORT, "
            "for example tcp/127.0.0.1:7447"
        )


def from_here(endpoint: str) -> str:
    """Where a learner that listens on ``endpoint`` is reached from its own machine.

    All addresses of a machine are no address of it: a certificate cannot be for them.
    """
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
