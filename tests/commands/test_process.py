"""Signals: the first one stops in order; a hurried second one ends at once, an echo does not."""

import subprocess
import sys

import pytest

SCRIPT = """
import os, signal, sys
from a2s.commands.process import stop_on_signals
with stop_on_signals() as stop:
    for number in map(int, sys.argv[1:]):
        os.kill(os.getpid(), number)
    print("in order", stop.exit_code)
"""


@pytest.mark.parametrize(
    ("numbers", "code", "said"),
    [
        (("15",), 0, b"in order 143\n"),
        (("15", "15"), 0, b"in order 143\n"),  # to the process, and to its group
        (("1", "1"), 0, b"in order 129\n"),
        (("2",), 0, b"in order 130\n"),
        (("2", "2"), 130, b""),
        (("15", "2"), 143, b""),
    ],
)
def test_a_second_signal_ends_at_once_unless_it_is_the_first_once_more(
    numbers: tuple[str, ...], code: int, said: bytes
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *numbers], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (code, said, b"")
