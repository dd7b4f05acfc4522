"""``a2s actor``: starts n worker processes, replaces those that die, shows what they count."""

import json
import logging
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import IO

from a2s.actors.metrics import Fleet
from a2s.actors.worker import EXIT_HOPELESS, Task
from a2s.protocol.errors import A2SError

logger = logging.getLogger(__name__)

_BACK_OFF_S = (0.2, 5.0)
_CRASH_LOOP_DEATHS = 5
_CRASH_LOOP_LIFE_S = 30.0
_STOP_S = 12.0
_POLL_S = 0.1


@dataclass(slots=True)
class _Worker:
    """One place and the process that holds it now."""

    task: Task
    process: "subprocess.Popen[str] | None" = None
    reader: threading.Thread | None = None
    started_s: float = 0.0
    start_at_s: float = 0.0
    deaths_in_a_row: int = 0
    last_words: list[str] = field(default_factory=list)


class Supervisor:
    """Keeps one worker process per task alive.

    A worker that dies is started again after a back-off that grows with every early death; after
    five early deaths in a row nothing is gained by going on, and :meth:`run` raises.

    Args:
        tasks: One per worker.
        fleet: Told what the workers count.
    """

    def __init__(self, tasks: list[Task], fleet: Fleet) -> None:
        self._workers = [_Worker(task) for task in tasks]
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
        finally:
            self._stop()

    def _look_after(self, index: int, worker: _Worker) -> None:
        now_s = time.monotonic()
        if worker.process is None:
            if now_s >= worker.start_at_s:
                self._start(index, worker)
            return
        code = worker.process.poll()
        if code is None:
            return
        self._bury(index, worker)
        words = worker.last_words[-1] if worker.last_words else "no last words"
        if code == EXIT_HOPELESS:
            raise A2SError(words)
        early = now_s - worker.started_s < _CRASH_LOOP_LIFE_S
        worker.deaths_in_a_row = worker.deaths_in_a_row + 1 if early else 1
        if worker.deaths_in_a_row >= _CRASH_LOOP_DEATHS:
            raise A2SError(
                f"worker {index} died {_CRASH_LOOP_DEATHS} times within {_CRASH_LOOP_LIFE_S:.0f} s "
                f"of its start (exit code {code}); last words: {words}"
            )
        shortest_s, longest_s = _BACK_OFF_S
        back_off_s = min(shortest_s * 2 ** (worker.deaths_in_a_row - 1), longest_s)
        worker.start_at_s = now_s + back_off_s
        self._fleet.restarted(index)
        logger.warning(
            "worker died worker=%d exit_code=%d restart_in_s=%.1f", index, code, back_off_s
        )

    def _start(self, index: int, worker: _Worker) -> None:
        worker.process = subprocess.Popen(
            [sys.executable, "-m", "a2s.actors.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        worker.started_s = time.monotonic()
        worker.last_words = []
        assert worker.process.stdin is not None
        worker.process.stdin.write(worker.task.to_json() + "\n")
        worker.process.stdin.flush()
        worker.reader = threading.Thread(
            target=self._read, args=(index, worker, worker.process.stdout), daemon=True
        )
        worker.reader.start()
        threading.Thread(
            target=_relay, args=(worker.process.stderr, worker.last_words), daemon=True
        ).start()

    def _read(self, index: int, worker: _Worker, lines: IO[str]) -> None:
        for line in lines:
            self._fleet.update(index, json.loads(line))

    def _bury(self, index: int, worker: _Worker) -> None:
        """Read what a dead worker still said, and keep what it counted."""
        assert worker.process is not None
        assert worker.reader is not None
        worker.reader.join()
        assert worker.process.stdin is not None
        worker.process.stdin.close()
        worker.process = None
        self._fleet.ended(index)

    def _stop(self) -> None:
        living = [(i, w) for i, w in enumerate(self._workers) if w.process is not None]
        for _, worker in living:
            assert worker.process is not None
            assert worker.process.stdin is not None
            worker.process.stdin.close()
        deadline_s = time.monotonic() + _STOP_S
        for index, worker in living:
            assert worker.process is not None
            try:
                worker.process.wait(timeout=max(0.1, deadline_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                logger.warning("worker does not stop, killed worker=%d", index)
                worker.process.kill()
                worker.process.wait()
            self._bury(index, worker)


def _relay(lines: IO[str], last_words: list[str]) -> None:
    """Pass a worker's words on, and remember the last ones."""
    for line in lines:
        sys.stderr.write(line)
        last_words[:] = [*last_words[-4:], line.strip()]
