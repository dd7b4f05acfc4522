"""Everything that a2s raises on purpose.

::

    A2SError                    one line: subject, what was found, what was expected, what to do
    ├── UsageError              the user asked for something impossible; exit code 2
    ├── UnreachableError        nobody answered before the deadline
    ├── RefusedError            the learner said no, and why
    ├── FaultyEnvironmentError  the user's environment raised, hung, or gave what none may give
    ├── MalformedMessageError   bytes or values that are not a message of this protocol
    │   ├── OversizeMessageError    more bytes than a message of this kind may have
    │   └── SchemaMismatchError     the peer speaks another version of the protocol
    └── RunDirectoryError       a run directory or checkpoint that cannot be used
"""

import difflib
from collections.abc import Iterable

_MOST = 500


class A2SError(Exception):
    """Root of the tree: expected failures that a user can read and act on."""


class UsageError(A2SError):
    """An option, key or value that cannot be used."""


class UnreachableError(A2SError):
    """A peer did not answer before the deadline."""


class RefusedError(A2SError):
    """The learner refused this peer."""


class FaultyEnvironmentError(A2SError):
    """An environment raised, hung, or gave what none may give.

    Args:
        message: One line: environment, call, what was found and expected, the user's file and line.
        by_mistake: Whether it would do so again, so that starting it anew is of no use.
    """

    def __init__(self, message: str, *, by_mistake: bool = False) -> None:
        super().__init__(message)
        self.by_mistake = by_mistake


class MalformedMessageError(A2SError):
    """A message is oversize, undecodable, incomplete or contradicts itself."""


class OversizeMessageError(MalformedMessageError):
    """A message has more bytes than its kind may have."""


class SchemaMismatchError(MalformedMessageError):
    """The peer speaks another version of the protocol."""


class RunDirectoryError(A2SError):
    """A run directory or a checkpoint is missing, damaged or of another kind."""


def one_line(words: str) -> str:
    """Make one short line of what somebody else says: it goes to logs, terminals and messages."""
    kept = "".join(c if c.isprintable() else " " for c in words[:_MOST])
    return " ".join(kept.split())


def said_by(error: BaseException) -> str:
    """Give an exception that anybody may have raised as one line."""
    name = type(error).__name__
    try:
        said = one_line(str(error))
    except Exception:  # noqa: BLE001  # a user's own __str__ may raise anything
        return one_line(name)
    return one_line(f"{name}: {said}") if said else one_line(name)


def nearest(name: str, valid: Iterable[str]) -> str:
    """Say which valid name is meant by a wrong one.

    Returns:
        ``" (did you mean 'gamma'?)"``, or the list of valid names when none is near.
    """
    names = sorted(valid)
    found = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f" (did you mean {found[0]!r}?)" if found else f" (valid: {', '.join(names)})"
