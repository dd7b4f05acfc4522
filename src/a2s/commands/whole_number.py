"""An option that is a whole number, and may be written as 1e6."""

from typing import Any

import typer

from a2s.learner.numerals import whole
from a2s.protocol.errors import UsageError

_LARGE = 100_000  # a range that ends beyond says nothing to a reader


def whole_number(
    *names: str, env: str | None = None, least: int | None = None, most: int | None = None,
    **more: Any,
) -> Any:  # fmt: skip
    """Make an option whose value is a whole number within a closed range.

    Args:
        names: Of the option, the long one first.
        env: Variable that it is read from where it is not given.
        least: Lowest value.
        most: Highest value.
        more: As `typer.Option` takes it.
    """
    subject = names[0] if env is None else f"{names[0]} or {env}"

    def integer(given: str | int) -> int:
        return parse(subject, given, least, most)

    is_small = least is not None and most is not None and most < _LARGE
    metavar = f"{least}..{most}" if is_small else "N"
    return typer.Option(*names, envvar=env, parser=integer, **{"metavar": metavar, **more})


def parse(subject: str, given: str | int, least: int | None, most: int | None) -> int:
    """Read the value of an option.

    Raises:
        UsageError: It is no whole number, or out of range.
    """
    try:
        number = whole(given)
    except ValueError:
        raise UsageError(
            f"{subject}: found {given!r}, expected a whole number such as 1000 or 1e6"
        ) from None
    if (least is not None and number < least) or (most is not None and number > most):
        span = f"at least {least}" if most is None else f"{least} to {most}"
        raise UsageError(f"{subject}: found {given}, expected {span}")
    return number
