"""Settings: fields of a frozen dataclass that say their default, range, meaning and source.

Command line, configuration files, error messages and the tables of docs/algorithm.md all read
them from here.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Generic, Literal, NamedTuple, TypeVar, get_args, get_origin

from a2s.learner.numerals import whole

_MAX_UNITS = 65536
_SIZES = "layer sizes such as 64,64"
_EXPECTED = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    tuple[int, ...]: _SIZES,
    tuple[str, ...]: "a list of texts",
}


class Setting(NamedTuple):
    """The default, range, meaning and source of a field; the range is closed, for numbers only."""

    meaning: str
    source: str
    low: float
    high: float


def setting(
    default: object,
    meaning: str,
    source: str = "",
    *,
    low: float = -math.inf,
    high: float = math.inf,
) -> Any:
    """Declare a field of `Settings`."""
    return field(default=default, metadata={"setting": Setting(meaning, source, low, high)})


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Base of the configurations; every value is checked when one is made.

    Raises:
        ValueError: A value has another type or is out of range; one line that names it.
    """

    def __post_init__(self) -> None:
        """Check every field by its type, then by its range."""
        for each in fields(self):
            _check(each.name, each.type, getattr(self, each.name), each.metadata["setting"])

    @classmethod
    def about(cls) -> dict[str, Setting]:
        """Meaning, source and range of every field, in their order."""
        return {each.name: each.metadata["setting"] for each in fields(cls)}

    @classmethod
    def parse(cls, given: Mapping[str, object]) -> dict[str, Any]:
        """Read values of known fields, from text or from a file.

        Raises:
            ValueError: A text cannot be read as the type of its field.
        """
        kinds = {each.name: each.type for each in fields(cls)}
        return {name: _parse(name, kinds[name], value) for name, value in given.items()}


S = TypeVar("S", bound=Settings)


class Preset(NamedTuple, Generic[S]):
    """A configuration, and the source of the values that are not defaults of its class."""

    config: S
    source: str


def refuse(name: str, found: object, expected: str) -> None:
    """Refuse a value.

    Raises:
        ValueError: Always.
    """
    raise ValueError(f"{name}: found {found}, expected {expected}")


def check_most(name: str, value: float, other: str, limit: float) -> None:
    """Refuse a value above that of another setting."""
    if value > limit:
        refuse(name, value, f"at most {other} ({limit})")


def _check(name: str, kind: Any, value: Any, about: Setting) -> None:
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        if value not in choices:
            refuse(name, repr(value), f"one of {', '.join(choices)}")
    elif kind is int or kind is float:
        _check_number(name, kind, value, about)
    elif kind == tuple[int, ...]:
        _check_sizes(name, value)
    elif kind == tuple[str, ...]:
        if not isinstance(value, tuple) or not all(isinstance(text, str) for text in value):
            refuse(name, repr(value), _EXPECTED[kind])
    elif not isinstance(value, kind):
        refuse(name, repr(value), _EXPECTED[kind])


def _check_number(name: str, kind: type, value: Any, about: Setting) -> None:
    allowed = (int,) if kind is int else (int, float)
    is_number = isinstance(value, allowed) and not isinstance(value, bool)
    if is_number and about.low <= value <= about.high:
        return
    low, high = (str(b) if isinstance(b, int) else f"{b:g}" for b in (about.low, about.high))
    span = f" from {low} to {high}" if about.high < math.inf else f" of at least {low}"
    refuse(name, value if is_number else repr(value), _EXPECTED[kind] + span)


def _check_sizes(name: str, value: object) -> None:
    if not isinstance(value, tuple) or not value:
        refuse(name, repr(value), _SIZES)
    else:
        for size in value:
            _check_number(name, int, size, Setting("", "", 1, _MAX_UNITS))


def _parse(name: str, kind: Any, given: object) -> object:
    try:
        if get_origin(kind) is tuple:
            return _parse_sizes(given) if kind == tuple[int, ...] else _as_tuple(given)
        if kind is int and isinstance(given, str | float):
            return whole(given)
        if kind is bool and isinstance(given, str):
            return _parse_bool(given)
        if kind is float and isinstance(given, str | int) and not isinstance(given, bool):
            return float(given)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: found {given!r}, expected {_EXPECTED[kind]}") from None
    return given


def _as_tuple(given: object) -> object:
    return tuple(given) if isinstance(given, list) else given


def _parse_sizes(given: object) -> tuple[int, ...]:
    if isinstance(given, str):
        return tuple(whole(part) for part in given.strip("[]() ").replace("-", ",").split(","))
    if isinstance(given, list | tuple):
        return tuple(whole(part) if isinstance(part, float) else part for part in given)
    raise TypeError


def _parse_bool(given: str) -> bool:
    words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
    if given.lower() not in words:
        raise ValueError
    return words[given.lower()]
