"""Progress: plain lines say all there is; the display says why it waits."""

import io
from math import inf

import pytest
from rich.console import Console

from a2s.learner.ingest.members import Member
from a2s.learner.run.progress import LiveView, PlainView, sparkline, thin
from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.status import Score, Status

ACTORS = [Member(actor=name, slot=0, num_envs=8, heard_s=inf) for name in "ab"]


@pytest.fixture
def status() -> Status:
    """After one update."""
    made = Status(RunConfig(total_steps=10_000), env_steps=2048, updates=1, version=2)
    for episode_return in (-4.5, 211.0):
        made.episodes.add(episode_return, 100, {"is_success": 0.5})
    return made


def test_a_plain_line_has_every_number(status: Status) -> None:
    out = io.StringIO()
    status.waiting_for = "segments of version 2 from actors [1]"
    status.evaluated(Score(1024, 1234.5, 67.0))
    PlainView(out).show(status, ACTORS, None)
    assert out.getvalue() == (
        "steps=2048 steps_per_s=0 return=103.2 best=211.0 episodes=2 version=2 recoveries=0 "
        "actors=2 evaluation=1234.5 is_success=0.5 "
        "waiting_for='segments of version 2 from actors [1]'\n"
    )


def test_tiny_returns_are_not_0() -> None:
    out, status = io.StringIO(), Status(RunConfig())
    status.episodes.add(-3.21e-6, 1, {})
    PlainView(out).show(status, [], None)
    assert " return=-3.21e-06 best=-3.21e-06 " in out.getvalue()


def test_lines_come_every_few_seconds_not_at_every_call(status: Status) -> None:
    out = io.StringIO()
    view = PlainView(out)
    for _ in range(100):
        view.show(status, ACTORS, None)
    assert out.getvalue().count("\n") == 1


def test_a_title_is_shown_as_it_is(status: Status) -> None:
    """An environment may lie in a folder whose name looks like markup."""
    out = io.StringIO()
    view = LiveView(Console(file=out, force_terminal=True, width=120), "a2s on [/b]/x.py:X")
    view.show(status, ACTORS, None)
    view.close()
    assert "a2s on [/b]/x.py:X" in out.getvalue()


def test_the_display_shows_the_numbers(status: Status) -> None:
    out = io.StringIO()
    view = LiveView(Console(file=out, force_terminal=True, width=120), "hopper")
    status.evaluated(Score(1024, 1234.5, 67.0))
    view.show(status, ACTORS, 0.0123)
    view.close()
    text = out.getvalue()
    for expected in (
        "hopper",
        "updates 1",
        "2,048 of 10,000",
        "103.2",
        "2 with 16 environments",
        "0.0123",
        "at 1,024",
        "has joined",
    ):
        assert expected in text


def test_what_off_policy_counts_are_gradient_steps() -> None:
    out, run = io.StringIO(), RunConfig(variant="off-policy", clock="async")
    view = LiveView(Console(file=out, force_terminal=True, width=120), "hopper")
    view.show(Status(run, updates=90), [], None)
    view.close()
    assert "gradient steps 90" in out.getvalue()


def test_a_curve_is_drawn_between_its_extremes_and_never_longer_than_a_line() -> None:
    """The newest point stays when a long curve is halved."""
    assert sparkline([0.0, 1.0, 2.0]) == " ▄█"
    assert sparkline([]) == ""
    curve: list[float] = []
    for value in range(200):
        curve = thin([*curve, float(value)])
        assert curve[-1] == value
        assert len(curve) <= 60
