"""Ctrl-C and SIGTERM: the first asks work for a clean stop, the second ends it at once."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_INTERRUPTED = 130


class Stop(threading.Event):
    """Set by the first signal.

    Attributes:
        interrupted: Whether it was a signal that set it.
    """

    interrupted = False


def end_on_signals() -> None:
    """Have SIGINT and SIGTERM end this process with 130, also where a shell had one ignored."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Give the event that SIGINT and SIGTERM set; a second signal ends the process at once."""
    stop = Stop()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if stop.interrupted:
            os._exit(EXIT_INTERRUPTED)
        stop.interrupted = True
        stop.set()

    before = {
        number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
