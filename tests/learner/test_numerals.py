"""Numbers as people write them, and as they like to read them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.numerals import whole, written


@pytest.mark.parametrize(
    ("text", "number"),
    [("1e6", 1_000_000), ("-2.50E1", -25), ("1_000", 1000), (" 7 ", 7), (64.0, 64), ("0e-9", 0)],
)
def test_whole_numbers_are_read_however_they_are_written(text: str | float, number: int) -> None:
    found = whole(text)
    assert (found, type(found)) == (number, int)


@pytest.mark.parametrize(
    "text", ["1.5e0", "1e-3", "inf", "-Infinity", "nan", "", "x", "1e999999999", 0.5, math.inf]
)
def test_what_is_no_whole_number_is_refused(text: str | float) -> None:
    with pytest.raises(ValueError, match="number"):
        whole(text)


@given(st.integers(-(2**70), 2**70))
def test_no_digit_is_lost(number: int) -> None:
    """A float has 53 bits; a seed has 63."""
    assert whole(str(number)) == whole(f"{number}.0") == number


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3193.4, "3193.4"),
        (-9.96, "-10.0"),
        (103.25, "103.2"),
        (0.0, "0.0"),
        (-0.0, "0.0"),
        (0.5, "0.5"),
        (-0.04321, "-0.0432"),
        (-3.21e-6, "-3.21e-06"),
        (1e-30, "1e-30"),
        (1234567.89, "1234567.9"),
        (1e9, "1e+09"),
        (-1234567890.0, "-1.2346e+09"),
        (math.inf, "inf"),
        (math.nan, "nan"),
    ],
)
def test_returns_are_written_with_digits_that_say_something(value: float, text: str) -> None:
    assert written(value) == text


@given(st.floats(-1e300, 1e300))
def test_what_is_written_is_near_what_is_meant(value: float) -> None:
    """Within a twentieth at any size, and short."""
    text = written(value)
    assert float(text) == pytest.approx(value, rel=0.05, abs=0.0)
    assert len(text) <= 12
