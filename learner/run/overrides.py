"""What a user sets hyperparameters to, as text or from a file, read by their types."""

from collections.abc import Mapping
from typing import Any, get_args, get_origin

from a2s.learner.run.numerals import whole
from a2s.learner.run.other_names import meant
from a2s.protocol.errors import UsageError

_WORDS = {int: "a whole number", float: "a number", bool: "true or false"}
_SIZES = "whole numbers such as 64,64"


def parse_all(
    overrides: Mapping[str, object], types: Mapping[str, Any], others: Mapping[str, str]
) -> dict[str, object]:
    """Values for hyperparameters, as `parse` reads each.

    Args:
        overrides: Of the right types, or text, by name.
        types: Of all hyperparameters, by name.
        others: What other libraries call them.

    Raises:
        UsageError: A name is unknown, the one that is meant is named; or a text cannot be read.
    """
    for name in overrides:
        if name not in types:
            raise UsageError(f"unknown hyperparameter {name!r}{meant(name, types, others)}")
    return {name: parse(name, given, types) for name, given in overrides.items()}


def parse(name: str, given: object, types: Mapping[str, Any]) -> object:
    """A value for a hyperparameter, from text or from a configuration file.

    Args:
        name: Of the hyperparameter.
        given: Of the right type, or text.
        types: Of all hyperparameters, by name.

    Raises:
        UsageError: The text cannot be read as the type of this hyperparameter.
    """
    kind = types[name]
    try:
        if get_origin(kind) is tuple:
            return _parse_sizes(given)
        if kind is int and isinstance(given, str | float):
            return whole(given)
        if isinstance(given, str) and get_args(kind) == ():
            return _parse_bool(given) if kind is bool else kind(given)
    except (TypeError, ValueError):
        raise UsageError(f"{name}: found {given!r}, expected {_WORDS.get(kind, _SIZES)}") from None
    return float(given) if kind is float and type(given) is int else given


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
