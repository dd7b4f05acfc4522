"""``a2s doctor``: what it finds, and what it says to do."""

import socket

import pytest

from a2s.commands.doctor import Finding, clock, line, port
from a2s.commands.process import run_apart


def test_a_line_has_the_finding_and_below_it_the_remedy() -> None:
    assert line(Finding("cores", "ok", "2 of 2")) == "ok    cores         2 of 2"
    assert line(Finding("disk", "fail", "0.1 GB free", "make room")) == (
        "fail  disk          0.1 GB free\n                    -> make room"
    )


def test_a_port_that_is_taken_is_told_and_a_free_one_too() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        number = taken.getsockname()[1]
        found = port(number, "take another")
        in_use = f"{number}: Address already in use; perhaps a run"
        assert found == ("port", "note", in_use, "take another")
    assert port(number, "take another") == ("port", "ok", f"{number} is free", "")


@pytest.mark.parametrize(
    ("learners_s", "state", "words"),
    [
        (100.0, "ok", "as the learner's"),
        (70.0, "note", "30 s ahead of"),
        (130.0, "note", "30 s behind"),
        (0.0, "note", "not told"),
    ],
)
def test_clocks_are_compared(learners_s: float, state: str, words: str) -> None:
    found = clock(100.0, learners_s)
    assert found.state == state
    assert words in found.found


def test_what_crashes_ends_its_own_process_alone() -> None:
    """A simulator may abort; an import may fail."""
    assert run_apart("import os; os.abort()") == "its process died of signal 6"
    assert run_apart("raise ValueError('no such model')") == "ValueError: no such model"
    done = run_apart("import os; print(os.environ['MUJOCO_GL'])", MUJOCO_GL="egl")
    assert not isinstance(done, str)
    assert done.stdout == "egl\n"
