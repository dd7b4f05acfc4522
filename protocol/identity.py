"""Who a peer is, and how it proves it: by a certificate, by a password, or not at all.

All that belongs to this peer is checked here, before a session is opened; `a2s.protocol.refusal`
finds out why others refuse it.
"""

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from a2s.protocol import access, passwords
from a2s.protocol.access import LEARNER
from a2s.protocol.errors import UsageError
from a2s.protocol.keys import Keys

NAMES_FILE = "names.txt"
_ENCRYPTED = ("tls", "quic")


@dataclass(frozen=True, slots=True)
class Identity:
    """A peer as others know it.

    Attributes:
        name: Common name or user name; empty: unknown.
        folder: With the files of its certificate; ``None``: it has none.
        settings: Of the session. They may hold a password and are shown to nobody.
    """

    name: str = ""
    folder: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict, repr=False)


ANYBODY = Identity()


@dataclass(frozen=True, slots=True)
class Security:
    """What the user chose: at most one of certificates and passwords.

    Attributes:
        tls: Folder with certificates, or the one that holds it.
        password_file: File with lines ``USER:PASSWORD``.
        insecure: Let anybody in who can reach the learner.
    """

    tls: str | None = None
    password_file: str | None = None
    insecure: bool = False

    def __post_init__(self) -> None:
        if self.tls is not None and self.password_file is not None:
            raise UsageError("--password-file: found with --tls, expected one; leave one out")

    def endpoint(self, endpoint: str) -> str:
        """Give the endpoint as it is used: with certificates ``tcp`` becomes ``tls``.

        Raises:
            UsageError: It can only be used with certificates, or not with them.
        """
        kind, slash, place = endpoint.partition("/")
        if self.tls is None:
            if kind in _ENCRYPTED:
                raise UsageError(
                    f"endpoint: found {endpoint} without certificates, expected --tls DIR; "
                    "`a2s certs` makes them"
                )
            return endpoint
        if slash and kind not in ("tcp", *_ENCRYPTED):
            raise UsageError(
                f"endpoint: found {endpoint} with --tls, expected tls/HOST:PORT or quic/HOST:PORT"
            )
        return f"tls/{place}" if kind == "tcp" else endpoint

    def peer(self, *roles: str) -> Identity:
        """Tell who connects, with one of these roles, the usual one first.

        Raises:
            UsageError: The certificate, or the user, is missing, unusable or of another role.
        """
        if self.tls is not None:
            return _certified(Path(self.tls), roles, "connect")
        path = None if self.password_file is None else Path(self.password_file)
        user = passwords.user_for(roles, path)
        if user is None:
            return ANYBODY
        credentials = {"user": user[0], "password": user[1]}
        return Identity(user[0], settings={"transport/auth/usrpwd": credentials})

    def listener(self, keys: Keys, endpoint: str) -> Identity:
        """Tell who listens, and what it lets whom do.

        Raises:
            UsageError: A file is missing or unusable, or strangers could join.
        """
        if self.tls is not None:
            own = _certified(Path(self.tls), (LEARNER,), "listen")
            assert own.folder is not None
            rules = access.rules(keys, "cert_common_names", [LEARNER, *names_in(own.folder)])
            return Identity(own.name, own.folder, {**own.settings, "access_control": rules})
        if self.password_file is not None:
            users = passwords.users(Path(self.password_file))
            settings = {
                "transport/auth/usrpwd": {"dictionary_file": self.password_file},
                "access_control": access.rules(keys, "usernames", users),
            }
            return Identity(settings=settings)
        if not self.insecure and not is_local(endpoint):
            raise UsageError(
                f"--listen: found {endpoint}, which others can reach, without --tls or "
                "--password-file; make certificates with `a2s certs`, or add --insecure if the "
                "network keeps strangers out"
            )
        return ANYBODY

    def words(self) -> list[str]:
        """Write it as options of a command."""
        found = [] if self.tls is None else ["--tls", self.tls]
        found += [] if self.password_file is None else ["--password-file", self.password_file]
        return [*found, "--insecure"] if self.insecure else found


def not_heard(question: str, known_as: str) -> str:
    """Ask what to ask when nobody answers: what is not allowed is not answered either."""
    names = f", and is {known_as!r} one of the names that it lets in" if known_as else ""
    return f"{question}{names}?"


def is_local(endpoint: str) -> bool:
    """Whether only processes of this machine can connect to it."""
    kind, _, place = endpoint.partition("/")
    host = place.rpartition(":")[0].strip("[]")
    if kind == "unixsock-stream" or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def folder_of(tls: Path, roles: tuple[str, ...]) -> Path:
    """Find the folder with certificates: ``--tls`` names it, or the one that holds it."""
    inner = [tls / role for role in roles if (tls / role).is_dir()]
    return inner[0] if inner else tls


def _certified(tls: Path, roles: tuple[str, ...], side: str) -> Identity:
    # Needs a tenth of a second, and nobody else needs it.
    from a2s.protocol import certificates

    folder = folder_of(tls, roles)
    name = certificates.read(folder, datetime.now(UTC)).name
    if access.role_of(name) not in roles:
        raise UsageError(
            f"{folder / certificates.CERTIFICATE}: found the certificate of {name!r}, "
            f"expected that of {' or '.join(roles)}; name its folder with --tls"
        )
    settings = {
        "root_ca_certificate": str(folder / certificates.AUTHORITY),
        f"{side}_certificate": str(folder / certificates.CERTIFICATE),
        f"{side}_private_key": str(folder / certificates.KEY),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    return Identity(name, folder, {f"transport/link/tls/{n}": v for n, v in settings.items()})


def names_in(folder: Path) -> list[str]:
    """Read the names of those who may join."""
    path = folder / NAMES_FILE
    try:
        names = path.read_text().split()
    except (OSError, ValueError) as error:
        found = error.strerror if isinstance(error, OSError) else "is no text"
        raise UsageError(
            f"{path}: {found}; expected the names of certificates that may join, one a "
            "line, as `a2s certs` writes them"
        ) from None
    for name in names:
        if access.role_of(name) in ("", LEARNER):
            raise UsageError(f"{path}: found {name[:40]!r}, expected {access.NAMES}")
    return names
