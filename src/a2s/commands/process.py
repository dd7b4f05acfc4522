"""The process of a command: signals, standard streams, logging, ports."""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import TypeVar

from a2s.protocol.errors import UsageError

EXIT_INTERRUPTED = 130
LEARNER_METRICS_PORT, ACTOR_METRICS_PORT = 9464, 9465

Served = TypeVar("Served")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STANDARD_ERROR = 2
_CHILD_S = 120.0


class Stop(threading.Event):
    """Set by the first signal; ``interrupted`` says whether it was set by a signal."""

    interrupted = False


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Give the event that SIGINT and SIGTERM set; a second signal ends the process at once."""
    stop = Stop()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if stop.interrupted:
            os._exit(EXIT_INTERRUPTED)
        stop.interrupted = True
        stop.set()

    before = {number: signal.signal(number, on_signal) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_on_signals() -> None:
    """Have SIGINT and SIGTERM end this process with 130, also where a shell had one ignored."""
    for number in _SIGNALS:
        signal.signal(number, signal.default_int_handler)


def open_standard_streams() -> None:
    """Open streams that were closed before this process began: pipes would take their numbers."""
    fd = os.open(os.devnull, os.O_RDWR)
    while fd <= _STANDARD_ERROR:
        fd = os.open(os.devnull, os.O_RDWR)
    os.close(fd)
    for number, name in ((1, "stdout"), (_STANDARD_ERROR, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def log_warnings() -> None:
    """Write warnings to standard error, as they are."""
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(message)s")


def pass_on(line: str) -> None:
    """Pass an environment's output on to standard error, if it is still open."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"{'' if line.startswith('environment ') else 'environment: '}{line}\n")


def free_endpoint() -> str:
    """Name an endpoint on this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def serve_on(port: int | None, usual: int, serve: Callable[[int], Served]) -> Served:
    """Serve on the port the user names; else on the usual one, or any where that is taken.

    Raises:
        UsageError: The port the user names is taken.
    """
    if port is not None:
        return serve(port)
    try:
        return serve(usual)
    except UsageError:
        return serve(0)


def run_apart(program: str, **variables: str) -> subprocess.CompletedProcess[str] | str:
    """Run a program by itself; returns the last line of its error where it fails."""
    command = [sys.executable, "-W", "ignore", "-c", program]
    environ = {**os.environ, **variables}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, env=environ, timeout=_CHILD_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {_CHILD_S:.0f} s"
    if done.returncode < 0:
        return f"its process died of signal {-done.returncode}"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    return done
