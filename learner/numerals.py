"""Reads the numbers that people write, and writes numbers for them."""

from decimal import Decimal, InvalidOperation

_MAX_DIGITS = 309  # as the largest float has; 1e999999999 would not fit into memory


def whole(given: str | float) -> int:
    """Read a whole number in any notation: ``1000000``, ``1e6``, ``1000.0``.

    Raises:
        ValueError: It is not one, for example ``1.5e0``, ``1e-3``, ``inf``, ``nan`` or a word.
    """
    try:
        number = Decimal(given)
    except InvalidOperation:
        raise ValueError(f"no number: {given!r}") from None
    is_short = number.is_finite() and number.adjusted() < _MAX_DIGITS
    if not is_short or number != number.to_integral_value():
        raise ValueError(f"no whole number: {given!r}")
    return int(number)


def written(value: float) -> str:
    """Write a return, or a deviation, legibly at any size: ``3193.4``, ``-3.21e-06``, ``1e+09``."""
    size = abs(value)
    if size == 0.0:
        return "0.0"  # and not -0.0
    if size < 1.0:
        return f"{value:.3g}"
    return f"{value:.1f}" if size < 1e8 else f"{value:.5g}"
