"""``a2s certs``: a private authority, and a folder with a certificate for each peer."""

import ipaddress
import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from a2s.protocol import access
from a2s.protocol.access import ACTOR, LEARNER, VIEWER
from a2s.protocol.certificates import AUTHORITY, AUTHORITY_KEY, KEY, Authority
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import NAMES_FILE, names_in

_LOCAL = ("localhost", "127.0.0.1", "::1")
_RENEWED = timedelta(days=30)
_HOST = re.compile(r"(?=.{1,253}$)[A-Za-z0-9-]{1,63}(\.[A-Za-z0-9-]{1,63})*")
_USES = {
    ACTOR: "actors and evaluators; copy it to their machines",
    VIEWER: "a2s status, a2s doctor, a2s replay, and learners with --replay-from",
}


def make(
    folder: Path, hosts: list[str], actors: list[str], viewers: list[str], days: int
) -> Iterator[str]:
    """Make what is not there, and anew what expires within 30 days.

    ``hosts`` are the names and addresses of the learner, besides those of a machine for itself; its
    certificate is made anew for others than before. ``actors`` and ``viewers`` are the names of
    certificates besides the ones for all of them.

    Yields:
        What is in ``folder``, in lines for a reader.

    Raises:
        UsageError: A name or host is impossible, or a file is damaged or cannot be written.
    """
    now = datetime.now(UTC)
    names = [ACTOR, VIEWER]
    names += [f"{ACTOR}-{name}" for name in actors] + [f"{VIEWER}-{name}" for name in viewers]
    for name in names:
        if not access.role_of(name):
            raise UsageError(f"a2s certs: found the name {name!r}, expected {access.NAMES}")
    hosts = [_host(host) for host in hosts]
    authority = _authority(folder, now)

    learner, names_file = folder / LEARNER, folder / LEARNER / NAMES_FILE
    old = [each.name for each in folder.iterdir() if access.role_of(each.name) in _USES]
    listed = names_in(folder / LEARNER) if names_file.exists() else old
    made = authority.issued(learner)
    wanted = {*_LOCAL, *(hosts or (made.hosts if made else ()))}
    if made is None or made.expires < now + _RENEWED or wanted != set(made.hosts):
        _write(learner, authority.issue(LEARNER, sorted(wanted), days, now))
    yield f"{learner}  the learner, at {', '.join(sorted(wanted))}"
    for name in sorted({*names, *old}):
        made = authority.issued(folder / name)
        if made is None or made.expires < now + _RENEWED:
            _write(folder / name, authority.issue(name, [], days, now))
        yield f"{folder / name}  {_USES[access.role_of(name)]}"
    # A name that was taken out of the list, to keep its owner out, stays out.
    added = [name for name in names if name not in (*listed, *old)]
    _write(learner, {NAMES_FILE: "".join(f"{name}\n" for name in [*listed, *added]).encode()})
    yield f"{folder / AUTHORITY_KEY}  signs certificates: keep it from all other machines"


def _authority(folder: Path, now: datetime) -> Authority:
    if (folder / AUTHORITY_KEY).exists() or (folder / AUTHORITY).exists():
        return Authority.read(folder, now)
    authority = Authority.new(now)
    _write(folder, authority.files())
    return authority


def _host(host: str) -> str:
    try:
        return str(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        if _HOST.fullmatch(host) is None:
            raise UsageError(
                f"--host: found {host!r}, expected a name or an address, without a port"
            ) from None
        return host.lower()


def _write(folder: Path, files: dict[str, bytes]) -> None:
    """Write files that only this user can read where they are keys."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, data in files.items():
            partial = folder / f"{name}.partial"
            mode = 0o600 if name in (KEY, AUTHORITY_KEY) else 0o644
            descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
            with open(descriptor, "wb") as file:
                file.write(data)
            partial.rename(folder / name)
    except OSError as error:
        raise UsageError(f"a2s certs: {error.filename}: {error.strerror}") from None
