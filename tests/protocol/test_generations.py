"""The number of a learner's start, made unique."""

from a2s.protocol.generations import MARK_BITS, MAX_STARTS, numbered, start_of


def test_later_starts_are_greater_whatever_their_marks() -> None:
    """And all fit into the integers of the wire."""
    most = (1 << MARK_BITS) - 1
    assert numbered(1, most) < numbered(2, 0) < numbered(2, 1)
    assert numbered(MAX_STARTS, most) < 1 << 63
    assert [start_of(numbered(start, most)) for start in (1, 2, MAX_STARTS)] == [1, 2, MAX_STARTS]


def test_learners_of_before_had_no_mark() -> None:
    assert start_of(3) == 3
