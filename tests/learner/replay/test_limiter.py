"""The samples-per-insert limiter: within its band, and never both sides waiting."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from a2s.learner.replay.limiter import Limiter
from a2s.protocol.errors import RunDirectoryError, UsageError

RATIOS = st.sampled_from([0.1, 0.5, 1.0, 3.7, 32.0, 256.0])
SIZES = st.integers(1, 300)


def test_it_blocks_whichever_side_is_ahead() -> None:
    """Ratio 2, batches of 10, segments of 5: error = 2 (inserts - 20) - samples, within 10."""
    limiter = Limiter(2.0, 20, 10.0, segment_steps=5, batch_size=10)
    assert not limiter.may_sample()
    for _ in range(4):
        assert limiter.may_insert()
        limiter.count_insert(5)
    assert limiter.error == 0.0
    assert limiter.may_insert()
    limiter.count_insert(5)
    assert limiter.error == 10.0
    assert not limiter.may_insert()
    for error in (0.0, -10.0):
        assert limiter.may_sample()
        limiter.count_sample()
        assert limiter.error == error
    assert not limiter.may_sample()
    assert limiter.may_insert()
    assert (limiter.insert_waits, limiter.sample_waits) == (1, 2)


@settings(deadline=None)
@given(
    ratio=RATIOS,
    min_size=st.integers(1, 1000),
    slack=st.floats(1.0, 5.0),
    segment_steps=SIZES,
    batch_size=SIZES,
    turns=st.lists(st.tuples(st.booleans(), st.integers(1, 300)), max_size=200),
)
def test_it_never_blocks_both_sides_and_holds_the_ratio(
    ratio: float,
    min_size: int,
    slack: float,
    segment_steps: int,
    batch_size: int,
    turns: list[tuple[bool, int]],
) -> None:
    """Both sides come in any order, with segments of any length up to the longest."""
    band = slack * max(ratio * segment_steps, batch_size)
    limiter = Limiter(ratio, min_size, band, segment_steps=segment_steps, batch_size=batch_size)
    for inserts, steps in turns:
        assert limiter.may_insert() or limiter.may_sample()
        length = 1 + steps % segment_steps
        assert limiter.inserts >= min_size or limiter.may_insert()
        assert limiter.inserts >= min_size or not limiter.may_sample()
        if inserts and limiter.may_insert():
            limiter.count_insert(length)
        elif limiter.may_sample():
            limiter.count_sample()
        if limiter.inserts >= min_size:
            assert -band <= limiter.error <= band + 1e-6
            wanted = ratio * (limiter.inserts - min_size)
            assert abs(limiter.samples - wanted) <= band + 1e-6


@settings(deadline=None)
@given(ratio=RATIOS, segment_steps=SIZES, batch_size=SIZES, share=st.floats(0.0, 0.999))
def test_a_band_with_which_both_could_wait_is_refused(
    ratio: float, segment_steps: int, batch_size: int, share: float
) -> None:
    """At the start, not after some hours."""
    band = share * max(ratio * segment_steps, batch_size)
    with pytest.raises(UsageError, match="samples per insert: band: found"):
        Limiter(ratio, 1, band, segment_steps=segment_steps, batch_size=batch_size)


@pytest.mark.parametrize("name", ["ratio", "min_size", "segment_steps", "batch_size", "band"])
@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf")])
def test_numbers_out_of_range_are_refused(name: str, value: float) -> None:
    """By name; an endless band is no limit, and allowed."""
    numbers = {"ratio": 1.0, "min_size": 1, "band": 9.0, "segment_steps": 1, "batch_size": 1}
    if name == "band" and value == float("inf"):
        Limiter(**{**numbers, name: value})  # type: ignore[arg-type]
        return
    with pytest.raises(UsageError, match=f"samples per insert: {name}: found"):
        Limiter(**{**numbers, name: value})  # type: ignore[arg-type]


@settings(deadline=None)
@given(inserts=st.integers(0, 10**12), samples=st.integers(0, 10**12), more=st.integers(0, 99))
def test_its_state_goes_through_a_checkpoint(inserts: int, samples: int, more: int) -> None:
    """And what was inserted since is due; what is no state is refused."""
    first, again = (Limiter(1.0, 1, 99.0, segment_steps=9, batch_size=9) for _ in range(2))
    first.inserts, first.samples = inserts, samples
    first.may_insert()
    first.may_sample()
    state = first.state(inserts)
    again.load(state, inserts)
    assert again.state(inserts) == state
    first.count_insert(more)
    assert first.state(inserts) == state
    again.load(state, inserts + more)
    assert again.state(again.inserts) == first.state(first.inserts)
    with pytest.raises(RunDirectoryError, match="found no usable 'error'"):
        again.load({"inserts": 3}, 3)


def test_after_a_checkpoint_another_ratio_holds_for_what_is_inserted_since() -> None:
    """And another replay is filled first again."""
    before, after = (Limiter(r, 100, 400.0, segment_steps=10, batch_size=10) for r in (10.0, 5.0))
    before.inserts, before.samples = 5_000, 48_900
    assert before.error == 100.0
    after.load(before.state(5_000), 5_020)
    assert after.error == 100.0 + 20 * 5.0
    before.load(before.state(5_000), 0)
    assert not before.may_sample()
    before.count_insert(102)
    assert before.may_sample()
    assert before.error == 20.0
