"""Processes that run a user's environment: their parent starts, hears, watches and ends them.

A child is its own session. Its standard input is empty. What it or its environment prints on
either stream are *words*, passed on line by line; its reports to the parent are lines of JSON
through a separate pipe. It ends when its parent does, with all processes that it has started.
"""

import contextlib
import functools
import importlib.util
import json
import logging
import os
import queue
import selectors
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from a2s.actors.activity import Activity, Doing, share
from a2s.actors.child_output import Lines, Words
from a2s.actors.descendants import FAMILY, end_family, inherit_orphans, start_guard
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, FaultyEnvironmentError, UsageError

logger = logging.getLogger(__name__)

_CHUNK = 1 << 16
_LOOK_EVERY_S = 0.1
_POLL_S = 0.02
_LAST_WORDS_S = 1.0
_READ_S = 30.0  # where the processor has much else to do
_SLOW_S = 10.0
_STOP_S = 12.0
_CLOSE_S = 5.0
UNHEARD = 74  # exit code of a child that can no longer report to its parent

Report = dict[str, Any]
_LIVING: set[int] = set()  # numbers of the children of this process, and of their guard
_MARK = uuid.uuid4().hex  # beginning of the families of this process's children


class Child:
    """One process. It runs ``module``, which makes a `a2s.actors.parent.Parent`, with a ``task``.

    ``on_report`` gets its reports and ``on_words`` the lines that it prints, both on one thread.
    """

    def __init__(
        self,
        module: str,
        task: Mapping[str, Any],
        on_report: Callable[[Report], None],
        on_words: Callable[[str], None],
    ) -> None:
        inherit_orphans()
        if not _LIVING:
            _LIVING.add(start_guard(f"{FAMILY}={_MARK}"))
        self._family = f"{_MARK}-{uuid.uuid4().hex}"
        self._on_report, self._on_words = on_report, on_words
        page = share()
        self._activity = Activity(page)
        report, theirs = os.pipe()
        words, their_words = os.pipe()
        their_life, self._life = os.pipe()
        given = (theirs, their_life, page)
        # The order of a set of texts is part of what a seed repeats.
        usual = {"PYTHONHASHSEED": "0"} | _library_of_glfw()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, *map(str, given)],
                stdin=subprocess.DEVNULL,
                stdout=their_words,
                stderr=their_words,
                pass_fds=given,
                start_new_session=True,
                env=usual | os.environ | {FAMILY: self._family},
            )
        finally:
            for fd in (theirs, their_words, their_life, page):
                os.close(fd)
        self.pid = self._process.pid
        self._code: int | None = None
        _LIVING.add(self.pid)
        with contextlib.suppress(BrokenPipeError):  # it has died already
            os.write(self._life, (json.dumps(task) + "\n").encode())
        self._reader = threading.Thread(target=self._read, args=(report, words), daemon=True)
        self._reader.start()

    def ended(self) -> int | None:
        """Give its exit code once it has ended, as `subprocess` counts; its family is gone then."""
        if self._code is None:
            flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
            if os.waitid(os.P_PID, self.pid, flags) is not None:
                self._bury()
        return self._code

    def doing(self) -> Doing | None:
        """Give the present call into an environment."""
        return self._activity.now()

    def kill(self) -> int:
        """End it and its family at once; gives its exit code."""
        if self.ended() is None:
            os.kill(self.pid, signal.SIGKILL)
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
            self._bury()
        assert self._code is not None
        return self._code

    def release(self) -> None:
        """Let it stop by itself."""
        if self._life >= 0:
            os.close(self._life)
            self._life = -1

    def stop(self, env_id: str, timeout_s: float = _STOP_S) -> None:
        """Let it stop; after ``timeout_s`` seconds, and what one ``close`` may take, end it."""
        self.release()
        deadline_s = time.monotonic() + timeout_s
        while self.ended() is None:
            doing = self.doing()
            if doing is not None and doing.call == "close" and doing.since_s < _SLOW_S:
                deadline_s = max(deadline_s, time.monotonic() + 1.0)  # and then the next one
            if time.monotonic() >= deadline_s:
                what = doing or "in no call into it"
                logger.warning("environment %s: %s; its process is killed", env_id, what)
                self.kill()
                return
            time.sleep(_POLL_S)

    def _bury(self) -> None:
        # Until it is waited for, no other process can have its number.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self._code = self._process.wait()
        _LIVING.discard(self.pid)
        end_family(self._family, living=_LIVING)
        self.release()
        self._reader.join(_READ_S)

    def _read(self, report: int, words: int) -> None:
        """Read until nobody can write, or until the child has ended and no more data comes."""
        lines = {report: Lines(self._take), words: Words(self._on_words)}
        ended_s = 0.0
        with selectors.DefaultSelector() as selector:
            for fd in lines:
                selector.register(fd, selectors.EVENT_READ)
            while selector.get_map():
                has_ended = self._code is not None
                ready = selector.select(_LOOK_EVERY_S)
                for key, _ in ready:
                    data = os.read(key.fd, _CHUNK)
                    lines[key.fd].feed(data)
                    if not data:
                        selector.unregister(key.fd)
                if has_ended:  # a process that still holds the pipes is not ours
                    ended_s = ended_s or time.monotonic()
                    if not ready or time.monotonic() - ended_s > _LAST_WORDS_S:
                        break
        for fd in lines:
            os.close(fd)

    def _take(self, line: str) -> None:
        try:
            found = json.loads(line)
        except ValueError:
            return  # the last one, torn by a kill
        self._on_report(found)


@functools.cache
def _library_of_glfw() -> dict[str, str]:
    """Name the library of glfw, which MuJoCo imports: to find it, glfw starts a Python."""
    found = importlib.util.find_spec("glfw")
    is_usual = os.environ.get("XDG_SESSION_TYPE") != "wayland"
    is_usual &= "PYGLFW_LIBRARY_VARIANT" not in os.environ
    if found is None or not found.submodule_search_locations or not is_usual:
        return {}
    library = Path(found.submodule_search_locations[0]) / "x11" / "libglfw.so"
    return {"PYGLFW_LIBRARY": str(library)} if library.exists() else {}


class Watch:
    """Detects a child that is held up in an environment for longer than ``timeout_s``.

    ``on_slow`` is called once for each call that has taken ten seconds.
    """

    def __init__(self, env_id: str, timeout_s: float, on_slow: Callable[[str], None]) -> None:
        self.env_id, self.timeout_s, self._on_slow = env_id, timeout_s, on_slow
        self._is_said = False

    def overdue(self, doing: Doing | None) -> str:
        """Say what has not returned in time; empty if nothing is overdue."""
        if doing is None or doing.since_s < min(_SLOW_S, self.timeout_s):
            self._is_said = False
            return ""
        # Nothing is lost with a close that does not return.
        limit_s = min(self.timeout_s, _SLOW_S) if doing.call == "close" else self.timeout_s
        if doing.since_s >= limit_s:
            return (
                f"environment {self.env_id}: {doing.call} of environment {doing.env_index} had not "
                f"returned after {limit_s:g} s (--env-timeout)"
            )
        if not self._is_said:
            self._is_said = True
            self._on_slow(f"environment {self.env_id}: {doing}, it may take {self.timeout_s:g} s")
        return ""


class Asked:
    """A child that answers once about an environment; close it."""

    def __init__(
        self, module: str, config: EnvConfig, on_words: Callable[[str], None], **task: Any
    ) -> None:
        self._env_id = config.env_id
        self._reports: queue.SimpleQueue[Report] = queue.SimpleQueue()
        self._watch = Watch(config.env_id, config.timeout_s, on_words)
        self._child = Child(module, {"env": config.to_json(), **task}, self._reports.put, on_words)

    def answer(self, proceed: Callable[[], bool] = lambda: True) -> Report:
        """Wait for what it reports under ``result``.

        Empty once ``proceed``, asked again and again, is false.

        Raises:
            UsageError: The child said so.
            FaultyEnvironmentError: The child said so, died, or was held up in a call.
        """
        child, held_up = self._child, ""
        while self._reports.empty() and child.ended() is None and not held_up:
            held_up = self._watch.overdue(child.doing())
            if not proceed():
                return {}
            time.sleep(_POLL_S)
        if not held_up:
            child.stop(self._env_id, _CLOSE_S)
        last, code = child.doing(), child.kill()
        if held_up:
            raise FaultyEnvironmentError(held_up)
        if self._reports.empty():
            raise FaultyEnvironmentError(death_of(self._env_id, code, last))
        report = self._reports.get()
        if "error" in report:
            raise _error_of(report["error"])
        return dict(report["result"])

    def close(self) -> None:
        """End it."""
        self._child.kill()


def ask_child(
    module: str,
    config: EnvConfig,
    on_words: Callable[[str], None],
    proceed: Callable[[], bool] = lambda: True,
    **task: Any,
) -> Report:
    """Run a child that answers once, and end it; see `Asked.answer`."""
    with contextlib.closing(Asked(module, config, on_words, **task)) as asked:
        return asked.answer(proceed)


def death_of(env_id: str, code: int, doing: Doing | None) -> str:
    """Describe how a child ended that reported nothing."""
    how = f"exit code {code}"
    if code == UNHEARD:
        how = "closing file descriptors that are not its own"
    elif code < 0:
        names = {int(s): s.name for s in signal.Signals}
        how = f"signal {names.get(-code, -code)}"
        how += " (from outside, or for want of memory)" if code == -signal.SIGKILL else ""
    where = f" in {doing.call} of environment {doing.env_index}" if doing else ""
    return f"environment {env_id}: its process ended by {how}{where}"


def _error_of(report: Report) -> A2SError:
    """Read an error that a child reported."""
    if report["kind"] == "usage":
        return UsageError(report["message"])
    return FaultyEnvironmentError(report["message"], by_mistake=report["by_mistake"])
