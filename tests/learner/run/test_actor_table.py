"""The table of actors in the terminal: who plays, how fast, and who does not."""

import io
from dataclasses import replace

from rich.console import Console

from a2s.learner.ingest.members import Member
from a2s.learner.run.actor_table import ActorTable
from a2s.protocol.messages import ActorStatus

STATUS = ActorStatus(
    actor="h", slot=0, weights_version=9, epoch=0, env_steps=1000, episodes=0, segments_sent=0,
    segments_answered=0, spooled_steps=0, leaving=False, doing="step of environment 3 for 0 s",
)  # fmt: skip


def _member(slot: int, heard_s: float = 100.0, **changed: object) -> Member:
    member = Member(actor=f"h-{slot}", slot=slot, num_envs=8, heard_s=heard_s)
    member.status = replace(STATUS, **changed)  # type: ignore[arg-type]
    return member


def _rows(table: ActorTable, members: list[Member], now_s: float) -> list[list[str]]:
    """The cells below the header, with 10 as the newest version."""
    out = io.StringIO()
    Console(file=out, width=100).print(table.draw(members, 10, now_s))
    lines = [line.split("  ") for line in out.getvalue().splitlines()]
    return [[cell.strip() for cell in line if cell.strip()] for line in lines[1:]]


def test_rates_are_of_the_last_seconds_and_trouble_comes_first() -> None:
    """Between what an actor has told, 250 steps a second; the other one is stuck."""
    table, stuck = ActorTable(), "step of environment 3 for 21 s"
    for second in range(3):
        members = [
            _member(0, env_steps=1000 + 250 * second), _member(1, doing=stuck, weights_version=3),
        ]  # fmt: skip
        rows = [_rows(table, members, 100.0 + second + late_s) for late_s in (0.0, 0.5)]
    assert rows == 2 * [[["h-1", "0", "7", stuck], ["h-0", "250", "1", "plays"]]]
    members[0] = _member(0, env_steps=1500)
    _rows(table, members, 107.0)
    members[0] = _member(0, env_steps=1600)
    assert _rows(table, members, 108.0)[1][1] == "100"  # what was 5 seconds ago is forgotten


def test_what_an_actor_says_is_shown_as_it_is() -> None:
    """It may look like markup, also like none that is right."""
    told = "step [/b] of [red]it for 9 s"
    assert _rows(ActorTable(), [_member(0, doing=told)], 100.0)[0][3] == told


def test_who_is_silent_or_has_told_nothing_yet_is_shown_so() -> None:
    new = Member(actor="new", slot=2, num_envs=1, heard_s=119.0)
    assert _rows(ActorTable(), [_member(0), new], 120.0) == [
        ["h-0", "-", "1", "silent for 20 s"],
        ["new", "-", "-", "has joined"],
    ]


def test_many_actors_are_a_few_rows() -> None:
    rows = _rows(ActorTable(), [_member(slot) for slot in range(11)], 100.0)
    assert [row[0] for row in rows] == [*(f"h-{slot}" for slot in range(8)), "and 3 more"]


def test_without_actors_there_is_no_table() -> None:
    assert ActorTable().draw([], 10, 100.0) is None
