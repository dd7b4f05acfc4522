"""What values hyperparameters may have."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin

from a2s.protocol.errors import UsageError


def check(
    hyper: Any,
    integers: Mapping[str, tuple[int, float]],
    numbers: Mapping[str, tuple[float, float]],
) -> None:
    """Check every field of a dataclass by its type, then by its range.

    Args:
        hyper: The dataclass.
        integers: Closed ranges of the integers, by name.
        numbers: Closed ranges of the numbers; infinity is a value only where it is the upper end.

    Raises:
        UsageError: A value is outside its range; one line that names it.
    """
    for field in fields(hyper):
        _check_kind(field.name, field.type, getattr(hyper, field.name))
    for name, (least, most) in integers.items():
        _check_integer(name, getattr(hyper, name), least, most)
    for name, (low, high) in numbers.items():
        _check_number(name, getattr(hyper, name), low, high)


def refuse(name: str, found: object, expected: str) -> None:
    """Say what was found and what was expected.

    Raises:
        UsageError: Always.
    """
    raise UsageError(f"{name}: found {found}, expected {expected}")


def _check_kind(name: str, kind: object, value: object) -> None:
    if get_origin(kind) is Literal and value not in get_args(kind):
        refuse(name, repr(value), f"one of {', '.join(get_args(kind))}")
    if kind is bool and not isinstance(value, bool):
        refuse(name, value, "true or false")
    if get_origin(kind) is tuple:
        _check_sizes(name, value)


def _check_integer(name: str, value: object, least: int, most: float) -> None:
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    if not is_integer or not least <= value <= most:  # type: ignore[operator]
        span = f"of at least {least}" if most == math.inf else f"from {least} to {most:g}"
        refuse(name, value, f"a whole number {span}")


def _check_number(name: str, value: object, low: float, high: float) -> None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:  # type: ignore[operator]
        span = f"of at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
        refuse(name, value, f"a number {span}")


def _check_sizes(name: str, value: object) -> None:
    if not isinstance(value, tuple) or not value:
        refuse(name, value, "layer sizes such as 64,64")
    for size in value:  # type: ignore[attr-defined]
        _check_integer(name, size, 1, 65536)


def check_most(name: str, value: float, other: str, limit: float) -> None:
    """Refuse a value above that of another hyperparameter."""
    if value > limit:
        refuse(name, value, f"at most {other} ({limit})")
