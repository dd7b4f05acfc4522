"""Signals: the first one stops in order; a hurried second one ends at once, an echo does not."""

import os
import signal
import subprocess
import sys

import pytest

from a2s.commands.process import SIGNALS, end_on_signals

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


WAITING = """
import os, signal, sys
from a2s.commands.process import stop_on_signals
left = int(sys.argv[1])
def trace(frame, event, argument):
    global left
    left -= event == "line"
    if left == 0:
        os.kill(os.getpid(), signal.SIGTERM)
    return trace
with stop_on_signals() as stop:
    sys.settrace(trace)
    while not stop.wait(0.001):
        pass
    sys.settrace(None)
    print(stop.exit_code)
"""


def test_whatever_a_signal_interrupts_in_waiting_for_it_the_wait_ends() -> None:
    """Line by line; the lock of an event of `threading` would be held at some of them."""
    waiting = [
        subprocess.Popen([sys.executable, "-c", WAITING, str(line)], stdout=subprocess.PIPE)
        for line in range(1, 31)
    ]
    try:
        assert [process.communicate(timeout=60)[0] for process in waiting] == [b"143\n"] * 30
    finally:
        for process in waiting:
            process.kill()
            process.communicate()


INTERRUPTED = """
import os, sys
from a2s.commands.process import SIGNALS, end_on_signals
with end_on_signals():
    try:
        os.kill(os.getpid(), int(sys.argv[1]))
    except SystemExit as error:
        raise ImportError("initialization failed") from error
"""


@pytest.mark.parametrize(("number", "code"), [("2", 130), ("15", 143), ("1", 129)])
def test_what_a_library_makes_of_a_signal_that_interrupts_its_import_is_not_shown(
    number: str, code: int
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, number], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (code, b"", b"")


FULL = """
import os, sys
from a2s.commands.process import check_streams, end_on_signals
check_streams()
with end_on_signals():
    sys.stdout.write("half a line")
    os.kill(os.getpid(), 15)
"""


def test_a_signal_has_its_exit_code_where_standard_output_is_full() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", FULL], stdout=full, stderr=subprocess.PIPE, check=False,
            timeout=60, env=os.environ | {"PYTHONUNBUFFERED": ""},
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (143, b"")


LOST = """
import ctypes, os, sys, threading
from a2s.commands import process
process._LOST_S = 1
class Library:
    def __del__(self):
        self.missing
    def __getattr__(self, name):
        os.kill(os.getpid(), int(sys.argv[2]))
with process.end_on_signals():
    library = Library()
    if sys.argv[1] == "destructor":
        del library
    elif sys.argv[1] == "C":
        assert ctypes.pythonapi.PyObject_HasAttrString(ctypes.py_object(library), b"missing") == 0
    else:
        threading.Thread(target=lambda: threading.Event().wait(0.2) or library.missing).start()
        sys.exit()
    threading.Event().wait(60)
"""


@pytest.mark.parametrize("where", ["destructor", "C", "the end of Python"])
@pytest.mark.parametrize(("number", "code"), [("2", 130), ("15", 143)])
def test_a_signal_whose_exception_is_lost_ends_the_process_all_the_same(
    where: str, number: str, code: int
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOST, where, number], capture_output=True, check=False, timeout=50
    )
    assert (done.returncode, done.stdout, done.stderr) == (code, b"", b"")


def test_another_error_stays_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {number: signal.getsignal(number) for number in SIGNALS}
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    try:
        with pytest.raises(KeyError), end_on_signals():
            raise KeyError
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
