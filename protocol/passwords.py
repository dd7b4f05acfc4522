"""Users and passwords, the simple alternative to certificates.

A file has a line ``USER:PASSWORD`` for each user; a user is named as in `a2s.protocol.access`. The
learner's file has those of all peers; a peer needs the line of one.
"""

import logging
import os
import stat
from pathlib import Path

from a2s.protocol.access import LEARNER, NAMES, role_of
from a2s.protocol.errors import UsageError

logger = logging.getLogger(__name__)

VARIABLE = "A2S_PASSWORD"


def users(path: Path) -> dict[str, str]:
    """Read a file: passwords by user. One that others may read is used, with a warning.

    Raises:
        UsageError: It cannot be read, or a line is something else. No message has a password.
    """
    try:
        lines = path.read_text().splitlines()
        is_open = path.stat().st_mode & (stat.S_IRGRP | stat.S_IROTH)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text"
        raise UsageError(
            f"--password-file: {path}: {reason}; name a file with lines USER:PASSWORD"
        ) from None
    if is_open:
        logger.warning("--password-file: %s: others may read it; chmod 600 %s", path, path)
    found: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        user, password = _user(line, f"--password-file: {path}, line {number}")
        if user in found:
            raise UsageError(
                f"--password-file: {path}, line {number}: found user {user!r} once more, "
                "expected one line for each"
            )
        found[user] = password
    if not found:
        raise UsageError(f"--password-file: {path}: empty, expected lines USER:PASSWORD")
    return found


def user_for(roles: tuple[str, ...], path: Path | None) -> tuple[str, str] | None:
    """Give the first user in a file, or else the one in the variable, with one of these roles.

    Returns:
        User and password; ``None`` if there is neither file nor variable.

    Raises:
        UsageError: None of them has such a role, or as `users`.
    """
    if path is not None:
        for user, password in users(path).items():
            if role_of(user) in roles:
                return user, password
        raise UsageError(
            f"--password-file: {path}: found no line of a user {' or '.join(roles)}, "
            f"expected one such as {roles[0]}:PASSWORD; the learner's file has it"
        )
    line = os.environ.get(VARIABLE)
    if line is None:
        return None
    user, password = _user(line, VARIABLE)
    if role_of(user) not in roles:
        raise UsageError(f"{VARIABLE}: found user {user!r}, expected one of {', '.join(roles)}")
    return user, password


def _user(line: str, subject: str) -> tuple[str, str]:
    user, _, password = line.partition(":")
    if not password or not password.isprintable() or password != password.strip():
        raise UsageError(f"{subject}: expected USER:PASSWORD, for example actor:PASSWORD")
    if role_of(user) in ("", LEARNER):
        raise UsageError(f"{subject}: found user {user[:40]!r}, expected {NAMES}")
    return user, password
