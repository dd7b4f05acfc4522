"""``a2s actor``: starts n workers, replaces those that die or hang, adds up their counts."""

import contextlib
import logging
import math
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

from a2s.actors.children import Child, Report, Watch, death_of
from a2s.actors.metrics import Fleet
from a2s.actors.task import Task
from a2s.protocol.env_config import TIMEOUT_S
from a2s.protocol.errors import A2SError

logger = logging.getLogger(__name__)

_BACK_OFF_S = (0.2, 5.0)
_DEATHS_WITHOUT_WORK = 5
_STOP_S = 12.0
_FAILED_S = 2.0
_POLL_S = 0.1
_MAX_SILENT_S = 60.0  # for a worker outside any call, which reports once a second


@dataclass(slots=True)
class _Worker:
    """One place and its present process."""

    task: Task
    watch: Watch
    child: Child | None = None
    start_at_s: float = 0.0
    deaths_in_a_row: int = 0
    accepted: float = 0.0
    has_worked: bool = False  # this process, or one before it
    is_given_up: bool = False
    error: str = ""
    is_hopeless: bool = False
    silent_s: float = 0.0  # counted in checks, so that no worker is late after all were suspended


class Supervisor:
    """Keeps one worker process per task alive.

    A worker that dies, or does not come back from its environment, is replaced after a back-off
    that grows with every death. After five in a row without an accepted segment it is given up, and
    :meth:`run` raises if no other worker has worked.
    """

    def __init__(self, tasks: list[Task], fleet: Fleet) -> None:
        self._workers = [_Worker(task, Watch("", TIMEOUT_S, logger.warning)) for task in tasks]
        self._fleet = fleet

    def run(self, stopped: threading.Event) -> None:
        """Supervise until stopped, then let the workers send what they hold and end.

        Raises:
            A2SError: A worker cannot work: it was refused, misused, or dies again and again.
        """
        try:
            while not stopped.is_set():
                for index, worker in enumerate(self._workers):
                    self._look_after(index, worker)
                stopped.wait(_POLL_S)
        except BaseException:
            self._stop(_FAILED_S)
            raise
        self._stop(_STOP_S)

    def _look_after(self, index: int, worker: _Worker) -> None:
        child = worker.child
        if worker.is_given_up:
            return
        if child is None:
            if time.monotonic() >= worker.start_at_s:
                self._start(index, worker)
            return
        doing = child.doing()
        worker.silent_s += _POLL_S
        cause = worker.watch.overdue(doing)
        if doing is None and worker.silent_s > _MAX_SILENT_S:
            name = worker.watch.env_id
            cause = f"environment {name}: its process had reported nothing for {_MAX_SILENT_S:g} s"
        code = child.kill() if cause else child.ended()
        if code is None:
            return
        worker.child = None
        self._fleet.ended(index)
        cause = worker.error or cause or death_of(worker.watch.env_id, code, doing)
        if worker.is_hopeless:
            raise A2SError(cause)
        self._replace(index, worker, cause)

    def _replace(self, index: int, worker: _Worker, cause: str) -> None:
        worker.deaths_in_a_row = 1 if worker.accepted else worker.deaths_in_a_row + 1
        if worker.deaths_in_a_row >= _DEATHS_WITHOUT_WORK:
            self._give_up(index, worker, cause)
            return
        shortest_s, longest_s = _BACK_OFF_S
        back_off_s = min(shortest_s * 2 ** (worker.deaths_in_a_row - 1), longest_s)
        worker.start_at_s = time.monotonic() + back_off_s
        worker.task = replace(worker.task, cause=cause)
        self._fleet.restarted(index)
        logger.warning("worker %d is replaced in %.1f s: %s", index, back_off_s, cause)

    def _give_up(self, index: int, worker: _Worker, cause: str) -> None:
        said = (
            f"worker {index} died {_DEATHS_WITHOUT_WORK} times in a row before it had done any "
            f"work; last: {cause}"
        )
        worker.is_given_up = True
        if not any(other.has_worked and not other.is_given_up for other in self._workers):
            raise A2SError(said)
        logger.error("%s; it is given up, the others go on", said)

    def _start(self, index: int, worker: _Worker) -> None:
        worker.accepted, worker.error, worker.is_hopeless = 0.0, "", False
        worker.silent_s = -math.inf  # until it reports for the first time
        worker.child = Child(
            "a2s.actors.worker",
            asdict(worker.task),
            lambda report: self._take(index, worker, report),
            _relay(index),
        )

    def _take(self, index: int, worker: _Worker, report: Report) -> None:
        worker.silent_s = 0.0
        if "samples" in report:
            self._fleet.update(index, report["samples"])
        if "accepted" in report:
            worker.accepted = report["accepted"]
            worker.has_worked |= worker.accepted > 0
        if "env_id" in report:
            worker.watch.env_id, worker.watch.timeout_s = report["env_id"], report["timeout_s"]
        if "error" in report:
            worker.error, worker.is_hopeless = report["error"]["message"], report["is_hopeless"]

    def _stop(self, timeout_s: float) -> None:
        """End all workers: together, so that the slowest one sets the time."""
        living = [(w.child, w.watch.env_id) for w in self._workers if w.child is not None]
        for child, _ in living:
            child.release()
        deadline_s = time.monotonic() + timeout_s
        for child, env_id in living:
            child.stop(env_id, max(0.1, deadline_s - time.monotonic()))
        for index, worker in enumerate(self._workers):
            if worker.child is not None:
                self._fleet.ended(index)


def _relay(index: int) -> Callable[[str], None]:
    """Pass a worker's words on, prefixed with its number."""

    def write(line: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # nobody reads it; the work goes on
            sys.stderr.write(f"worker {index}: {line}\n")

    return write
