"""Serving over HTTP: where, and how it is said that nothing can be served there."""

import errno
import socket

from a2s.protocol.errors import UsageError


def family_of(host: str, port: int) -> socket.AddressFamily:
    """Whether to listen by IPv4 or IPv6.

    Raises:
        OSError: There is no such machine.
        UnicodeError: It is no name of one.
    """
    return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]


def url_of(host: str, port: int, path: str) -> str:
    """The address to ask, ``path`` beginning with a slash."""
    return f"http://[{host}]:{port}{path}" if ":" in host else f"http://{host}:{port}{path}"


def not_served(host: str, port: int, option: str, error: OSError | UnicodeError) -> UsageError:
    """Say why nothing can be served there; ``option`` names the port, and another the host."""
    why = "no name of a machine" if isinstance(error, UnicodeError) else error.strerror
    if isinstance(error, UnicodeError | socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        name = option.replace("port", "host")
        return UsageError(f"{name}: found {host!r}, expected an address of this machine: {why}")
    subject = option.strip("-").replace("-", " ")
    return UsageError(f"{subject} {port}: {why}; choose another with {option}, 0 = any")
