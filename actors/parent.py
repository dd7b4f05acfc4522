"""The link of a child process to its parent: a task, a way to report, and its end."""

import contextlib
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

from a2s.actors.activity import Activity
from a2s.actors.children import UNHEARD, Report
from a2s.actors.descendants import FAMILY, end_family, inherit_orphans, reap_orphans
from a2s.actors.environments.faults import Faults
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, UsageError

_REAP_EVERY_S = 1.0


class Parent:
    """The parent's end of this process; a process makes it first.

    The working directory is searched for modules last, so that a user's own are found but do not
    hide ours, or Python's, of the same name.

    Attributes:
        task: The parent's message.
        stderr: Stream for the messages of this process.
        activity: The page on which calls into environments are noted.
        stopped: Set when the parent lets this process stop, or has died.
    """

    def __init__(self, descriptors: list[str]) -> None:
        self._report, life, page = (int(text) for text in descriptors)
        del sys.argv[1:]  # an environment may read it
        for fd in (self._report, life, page):
            os.set_inheritable(fd, False)
        for stream in (sys.stdout, sys.stderr):
            stream.reconfigure(line_buffering=True, errors="replace")  # type: ignore[union-attr]
        # An environment may close or replace the streams: ours is one more of the same place.
        self.stderr = os.fdopen(os.dup(2), "w", buffering=1, errors="replace")
        logging.basicConfig(level=logging.INFO, stream=self.stderr, format="%(message)s")
        logging.raiseExceptions = False
        _Logger.take(logging.root.handlers[0])
        sys.path.append(os.getcwd())
        self.activity = Activity(page)
        self.stopped = threading.Event()
        self._parent, self._family = os.getppid(), os.environ.get(FAMILY, "")
        inherit_orphans()
        self._lock = threading.Lock()
        lines = os.fdopen(life, "rb", buffering=0)
        self.task: dict[str, Any] = json.loads(lines.readline() or b"{}")
        threading.Thread(target=self._await_end, args=(lines.read,), daemon=True).start()
        threading.Thread(target=self._reap, daemon=True).start()

    def report(self, report: Report) -> None:
        """Tell the parent something that survives JSON."""
        data = (json.dumps(report) + "\n").encode()
        with self._lock:
            try:
                while data:
                    data = data[os.write(self._report, data) :]
            except BrokenPipeError:  # nobody reads
                self.stopped.set()
            except OSError:  # the environment has closed it
                self.leave(UNHEARD)

    def leave(self, code: int) -> None:
        """End this process and its family at once: the parent may end before it could do so."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):  # it may be a user's own by now
                stream.flush()
        end_family(self._family, living=set())
        if os.getppid() != self._parent:  # else it ends our group once we are gone
            os.killpg(0, signal.SIGKILL)
        os._exit(code)

    def _await_end(self, read: Callable[[int], bytes]) -> None:
        while read(1):
            pass
        self.stopped.set()

    def _reap(self) -> None:
        while not self.stopped.wait(_REAP_EVERY_S):
            with contextlib.suppress(OSError):  # an environment may hold all file descriptors
                reap_orphans()


def answer(work: Callable[[Parent], None]) -> None:
    """Run a child that reports one ``result``, and end this process."""
    parent = Parent(sys.argv[1:])
    try:
        work(parent)
    except A2SError as error:
        parent.report({"error": told(error)})
    except BaseException as error:  # noqa: BLE001  # whatever a user's code raises
        name = EnvConfig.from_json(parent.task["env"]).env_id
        parent.report({"error": told(Faults(name).raised("its process", error))})
    parent.leave(0)


def told(error: A2SError) -> Report:
    """Encode an error for a parent."""
    by_mistake = getattr(error, "by_mistake", False)
    kind = "usage" if isinstance(error, UsageError) else "faulty"
    return {"kind": kind, "message": str(error), "by_mistake": by_mistake}


class _Logger(logging.Logger):
    """Makes one of our loggers ignore any logging configuration of an environment."""

    ours: logging.Handler

    @classmethod
    def take(cls, handler: logging.Handler) -> None:
        """Send the output of all our loggers to a handler."""
        cls.ours = handler
        for name in [name for name in logging.root.manager.loggerDict if name.startswith("a2s.")]:
            logging.getLogger(name).__class__ = cls

    def isEnabledFor(self, level: int) -> bool:  # noqa: N802  # the name that it has there
        return level >= logging.INFO

    def handle(self, record: logging.LogRecord) -> None:
        self.ours.handle(record)
