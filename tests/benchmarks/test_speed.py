"""Tables of speed: medians, ranges and ratios within a round; every contender is one."""

import importlib

import pytest
from speed import stepping
from speed.run import TABLES, Row, Table, plain_table, rounds_table


def _row(contender: str, turn: int, value: float, *, work: str = "Hopper-v5") -> Row:
    cells = {"table": "loops", "commit": "abc", "machine": "2 cores", "unit": "steps/s"}
    more = {"work": work, "contender": contender, "round": str(turn), "value": str(value)}
    return {**cells, **more}


def test_a_ratio_is_the_median_of_those_within_a_round() -> None:
    """Ours 10, 30, 60 beside 10, 10, 30: ratios 1, 3, 2. Ratios of medians would say 3."""
    table = Table(("m: ours", "m: other"), ("m: other",), ("Hopper-v5",), "steps/s", 1.0)
    pairs = ((10, 10), (30, 10), (60, 30))
    rows = [_row("m: ours", turn, ours) for turn, (ours, _) in enumerate(pairs)]
    rows += [_row("m: other", turn, other) for turn, (_, other) in enumerate(pairs)]
    head, _, ours, other, _, rounds = rounds_table(table, rows).splitlines()
    assert head == "| work | contender | steps/s | range | to m: other |"
    assert ours == "| Hopper-v5 | m: ours | 30 | 10 to 60 | 2.00 |"
    assert other == "| Hopper-v5 | m: other | 10 | 10 to 30 | 1.00 |"
    assert rounds == "3 rounds."


def test_what_bench_says_is_told_with_its_ratio() -> None:
    rows = [_row("encode", 0, 1234.5, work=""), _row("encode", 0, 0.5, work="ratio")]
    assert plain_table(rows).splitlines()[-1] == "|  | encode | 1,234 steps/s | 0.5 |"


def test_every_contender_is_one() -> None:
    for table in TABLES.values():
        assert set(table.against) <= set(table.contenders)
        for contender in table.contenders:
            module, name = contender.split(": ", 1)
            assert name in importlib.import_module(f"speed.{module}").CONTENDERS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gym.make", "fast path", "physics", "acting, K 10"])
def test_every_way_of_stepping_steps(name: str) -> None:
    make, _ = stepping.CONTENDERS[name]
    some = make("Hopper-v5", 0)
    assert some() >= 256
    assert some() >= 256
