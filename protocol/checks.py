"""Checks of names, numbers and conditions that messages share; no array is needed for them."""

import re

from a2s.protocol.errors import MalformedMessageError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}")
NAME = "at most 96 of letters, digits, _ . -, beginning with no . or -"
METRIC_NAME = "1 to 96 printable characters"
MAX_METRICS = 32


def is_name(text: str) -> bool:
    """Tell whether a run or an actor can have this name: it is `NAME`, so it fits in a key."""
    return _NAME.fullmatch(text) is not None


def is_metric_name(text: str) -> bool:
    """Tell whether a metric can have this name: it is `METRIC_NAME`, so it breaks no line."""
    return 0 < len(text) <= 96 and text.isprintable()


def require(condition: bool, subject: str, found: object, expected: str) -> None:
    """Raise MalformedMessageError unless the condition holds."""
    if not condition:
        raise MalformedMessageError(f"{subject}: found {found!s:.100}, expected {expected}")


def require_counts(subject: str, message: object, *names: str) -> None:
    """Raise MalformedMessageError for the first of these fields of a message that is negative."""
    for name in names:
        found = getattr(message, name)
        require(found >= 0, f"{subject}: {name}", found, ">= 0")
