"""Serving over HTTP: how it is said that nothing can be served somewhere."""

import errno
import socket

from a2s.protocol.errors import UsageError


def not_served(host: str, port: int, option: str, error: OSError | UnicodeError) -> UsageError:
    """Say why nothing can be served there; ``option`` names the port, and another the host."""
    why = "no name of a machine" if isinstance(error, UnicodeError) else error.strerror
    if isinstance(error, UnicodeError | socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        name = option.replace("port", "host")
        return UsageError(f"{name}: found {host!r}, expected an address of this machine: {why}")
    subject = option.strip("-").replace("-", " ")
    return UsageError(f"{subject} {port}: {why}; choose another with {option}, 0 = any")
