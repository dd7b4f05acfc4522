"""Why a peer was not let in, as far as it can find out: zenoh itself says "timeout".

The standard library's TLS says it in words, in a handshake of its own.
"""

import socket
import ssl
from contextlib import closing
from pathlib import Path

from a2s.protocol.identity import Identity

_REACH_S = 2.0
_SILENT_S = 1.0  # longer than the way to the end of a tunnel and back
_ALERT_S = 0.5  # what the other side has against our certificate comes after the handshake
_NEW = "make a new one with `a2s certs` where the authority is"

# By OpenSSL's names: what the other side says of our certificate, and what to do.
_FOREIGN = f"of another authority than the learner's; {_NEW}"
_ALERTS = {
    "CERTIFICATE_EXPIRED": f"expired, by the learner's clock; compare the clocks, or {_NEW}",
    "UNKNOWN_CA": _FOREIGN,
    "DECRYPT_ERROR": _FOREIGN,  # of an authority with the same name
}
_EXPIRED, _NOT_YET, _PURPOSE, _HOST, _ADDRESS = 10, 9, 26, 62, 64  # of X509_V_ERR
_NO_TLS = "what listens there speaks no TLS; start the learner with --tls, or leave it out here"


def is_awaited(endpoint: str) -> bool:
    """Whether something listens there and waits for a word.

    A tunnel or a forwarded port without a learner behind it takes a connection, and ends it.
    """
    try:
        link = _reach(endpoint)
    except OSError:  # it timed out as well, where what is sent is lost
        return False
    with closing(link):
        link.settimeout(_SILENT_S)
        try:
            return bool(link.recv(1))
        except TimeoutError:
            return True
        except OSError:
            return False


def has_address(endpoint: str) -> bool:
    """Whether the host of an endpoint has an address here."""
    if endpoint.startswith("unixsock-stream/"):
        return True
    try:
        socket.getaddrinfo(*_host_and_port(endpoint))
    except (OSError, UnicodeError):
        return False
    return True


def why(endpoint: str, identity: Identity) -> str:
    """Find out why what listens at ``endpoint`` does not let this peer in; empty: unknown."""
    if endpoint.startswith("tls/") and identity.folder is not None:
        return _why_not(endpoint, identity.folder)
    if endpoint.startswith("tcp/") and _speaks_tls(endpoint):
        return "what listens there wants a certificate; name the folder of one with --tls DIR"
    return ""


def _why_not(endpoint: str, folder: Path) -> str:
    from a2s.protocol.certificates import AUTHORITY, CERTIFICATE, KEY

    host = _host_and_port(endpoint)[0]
    context = ssl.create_default_context(cafile=folder / AUTHORITY)
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    try:
        with (
            closing(_reach(endpoint)) as link,
            context.wrap_socket(link, server_hostname=host) as secured,
        ):
            secured.settimeout(_ALERT_S)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _against_the_learner(error, host, folder / AUTHORITY)
    except ssl.SSLError as error:
        for name, said in _ALERTS.items():
            if name in (error.reason or ""):
                return f"{folder / CERTIFICATE} is {said}"
        return _NO_TLS if error.reason == "WRONG_VERSION_NUMBER" else ""
    except OSError:
        return ""
    return ""


def _against_the_learner(error: ssl.SSLCertVerificationError, host: str, authority: Path) -> str:
    subject = "the learner's certificate"
    if error.verify_code in (_EXPIRED, _NOT_YET):
        return f"{subject} is not valid now; compare the clocks, or {_NEW} and start the learner"
    if error.verify_code in (_HOST, _ADDRESS):
        return (
            f"{subject} is not for {host}; connect by a name that it has, or make it anew with "
            f"`a2s certs --host {host}`"
        )
    if error.verify_code == _PURPOSE:
        return "what listens there has no learner's certificate; it is not the learner"
    return f"{subject} is not of the authority {authority}; copy the folder that `a2s certs` made"


def _speaks_tls(endpoint: str) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with closing(_reach(endpoint)) as link, context.wrap_socket(link):
            return True
    except OSError:
        return False


def _reach(endpoint: str) -> socket.socket:
    if endpoint.startswith("unixsock-stream/"):
        link = socket.socket(socket.AF_UNIX)
        try:
            link.connect(endpoint.partition("/")[2])
        except OSError:
            link.close()
            raise
        return link
    return socket.create_connection(_host_and_port(endpoint), timeout=_REACH_S)


def _host_and_port(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)
