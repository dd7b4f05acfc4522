"""The errors that a2s raises on purpose, and how errors are worded."""

import difflib
from collections.abc import Iterable

_MAX_LINE = 500


class A2SError(Exception):
    """An expected failure. One line: subject, what was found, what was expected, what to do."""


class UsageError(A2SError):
    """An option, key or value that cannot be used; exit code 2."""


class UnreachableError(A2SError):
    """A peer did not answer before the deadline."""


class RefusedError(A2SError):
    """The learner refused this peer."""


class FaultyEnvironmentError(A2SError):
    """The user's environment raised, hung, or returned what it must not.

    ``by_mistake``: it would happen again, so a restart is of no use.
    """

    def __init__(self, message: str, *, by_mistake: bool = False) -> None:
        super().__init__(message)
        self.by_mistake = by_mistake


class MalformedMessageError(A2SError):
    """A message is undecodable, incomplete or contradicts itself."""


class OversizeMessageError(MalformedMessageError):
    """A message has more bytes than its kind may have."""


class SchemaMismatchError(MalformedMessageError):
    """The peer speaks another version of the protocol."""


class RunDirectoryError(A2SError):
    """A run directory or a checkpoint is missing, damaged or of another kind."""


def one_line(words: str) -> str:
    """Make one short printable line of a foreign text, for logs, terminals and messages."""
    kept = "".join(c if c.isprintable() else " " for c in words[:_MAX_LINE])
    return " ".join(kept.split())


def said_by(error: BaseException) -> str:
    """Give an exception that anybody may have raised as one line."""
    name = type(error).__name__
    try:
        said = one_line(str(error))
    except Exception:  # noqa: BLE001  # a user's own __str__ may raise anything
        said = ""
    return one_line(f"{name}: {said}" if said else name)


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return ``" (did you mean 'gamma'?)"``, or the list of valid names if none is near."""
    names = sorted(valid)
    found = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f" (did you mean {found[0]!r}?)" if found else f" (valid: {', '.join(names)})"
