"""The process of a command: signals, standard streams, logging, ports."""

import contextlib
import errno
import logging
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, TextIO, TypeVar, cast

from a2s.protocol.errors import A2SError, UsageError

EXIT_FAILED = 1
LEARNER_METRICS_PORT, ACTOR_METRICS_PORT = 9464, 9465

Served = TypeVar("Served")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STANDARD_ERROR = 2
_CHILD_S = 120.0
_REPEATED_S = 1.0
_LOST_S = 8
_LOOK_EVERY_S = 0.05


def exit_code(number: int) -> int:
    """As shells have it: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP."""
    return 128 + number


class Stop(threading.Event):
    """Set by the first signal; ``number`` is that of the signal, 0 without one.

    It has no lock: whom the signal interrupts may hold that of any other event, in `wait`, and the
    handler would wait for it for ever.
    """

    number = 0
    _is_set = False

    def set(self) -> None:
        """Set it."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether it is set."""
        return self._is_set

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, for ``timeout`` seconds at most; gives whether it is."""
        end_s = math.inf if timeout is None else time.monotonic() + timeout
        while not self._is_set and (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, _LOOK_EVERY_S))
        return self._is_set

    @property
    def interrupted(self) -> bool:
        """Whether it was set by a signal."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """That of the signal; 0 without one."""
        return exit_code(self.number) if self.number else 0


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Give the event that signals set; a second signal ends the process at once.

    But not the same one within a second, except Ctrl-C: ``timeout`` and service managers send it to
    a process and to its group.
    """
    stop, first_s = Stop(), 0.0

    def on_signal(number: int, _frame: FrameType | None) -> None:
        nonlocal first_s
        if stop.interrupted:
            is_repeated = number == stop.number and time.monotonic() - first_s < _REPEATED_S
            if number != signal.SIGINT and is_repeated:
                return
            os._exit(stop.exit_code)
        stop.number, first_s = number, time.monotonic()
        stop.set()

    before = {number: signal.signal(number, on_signal) for number in _signals()}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def end_on_signals() -> Iterator[None]:
    """Have signals end this process with the exit code of a `Stop`, without a word.

    Whatever they interrupt may make another error of the exception that they raise: a library that
    is being imported does. Or it is lost: in a destructor, a callback, or in C code that takes any
    error for a no. Then the process is ended as it is.
    """
    end = _End()
    sys.unraisablehook = end.on_lost
    for number in _signals():
        signal.signal(number, end.on_signal)
    try:
        yield
    except BaseException:  # it is passed on, unless it comes of a signal
        if end.interrupted:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError, OutputError):
                    stream.flush()
            end.now()
        raise


class _End(Stop):
    """An end by an exception, or at once where that is lost."""

    def __init__(self) -> None:
        super().__init__()
        self._show_lost = sys.unraisablehook

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        if self.interrupted:
            self.now()
        self.number = number
        signal.signal(signal.SIGALRM, self.now)
        signal.alarm(_LOST_S)
        raise SystemExit(self.exit_code)

    def on_lost(self, lost: "sys.UnraisableHookArgs") -> None:
        if self.interrupted and lost.exc_type is SystemExit:
            self.now()
        self._show_lost(lost)

    def now(self, *_: object) -> None:
        os._exit(self.exit_code)


def _signals() -> list[signal.Signals]:
    """Those to stop on: not SIGHUP if `nohup` has it ignored, as shells have SIGINT behind them."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [each for each in SIGNALS if not (ignored and each == signal.SIGHUP)]


class OutputError(A2SError):
    """Standard output cannot be written; ``is_closed``: whoever read it has gone."""

    def __init__(self, cause: OSError) -> None:
        super().__init__(
            f"standard output: {cause.strerror}; make room there, or send it elsewhere"
        )
        self.is_closed = cause.errno == errno.EPIPE


class _Checked:
    """A standard stream that is flushed at the end of a line, so that a defect shows here."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        """Whatever else a stream has."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write.

        Raises:
            OutputError: It cannot be written, and this stream does not outlast that.
        """
        with self._watched():
            self._stream.write(text)
            if "\n" in text:
                self._stream.flush()
        return len(text)

    def flush(self) -> None:
        """Flush; raises as `write` does."""
        with self._watched():
            self._stream.flush()

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(error) from None


class _Lasting(_Checked):
    """A standard stream that may break: then its words are lost, and nothing else happens."""

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, OutputError):
            self._lose()

    def _lose(self) -> None:
        """Have the rest go nowhere, so that what is buffered does not fail again at the end."""
        with contextlib.suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self._stream.fileno())


def check_streams() -> None:
    """Have a defect of standard output raise `OutputError`, and one of standard error be nothing.

    Whoever has called this flushes standard output at the end: Python does it too late to tell.
    """
    sys.stdout, sys.stderr = cast(TextIO, _Checked(sys.stdout)), cast(TextIO, _Lasting(sys.stderr))


def outlast_streams() -> None:
    """Go on when standard output or error is closed or full: a run is worth more than its words."""
    sys.stdout, sys.stderr = (cast(TextIO, _Lasting(each)) for each in (sys.stdout, sys.stderr))


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


def cores_here() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


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
