"""The generation of a learner: which start of its run directory this is, and a mark of its own.

It grows from start to start, and no learner has that of another.
"""

MARK_BITS = 32
MAX_STARTS = (1 << 63 - MARK_BITS) - 1


def numbered(start: int, mark: int) -> int:
    """Make the generation of a start, 1 to `MAX_STARTS`; ``mark`` is of 32 random bits."""
    return start << MARK_BITS | mark


def start_of(generation: int) -> int:
    """Which start it is, as people count; learners of before had no mark."""
    return generation >> MARK_BITS or generation
