"""The process of one actor, started by the supervisor: ``python -m a2s.actors.worker``.

It reads its task as one line of JSON from standard input, writes snapshots of its counts as lines
of JSON to standard output, and stops when standard input ends: so it also stops when its
supervisor is killed. Exit code 2 means that starting it again is of no use.
"""

import json
import logging
import signal
import sys
import threading
import uuid
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import TextIO

from a2s.actors.actor import Actor
from a2s.actors.metrics import Tally
from a2s.protocol.errors import A2SError, RefusedError, UsageError
from a2s.protocol.zenoh_bus import ZenohBus

EXIT_FAILED = 1
EXIT_HOPELESS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What a worker is told by its supervisor.

    Attributes:
        label: Place among the workers, for names and messages, for example ``host-0``.
        connect: Endpoint of the learner.
        run: Name of the run.
        num_envs: Environments to step; ``None`` leaves it to the learner.
        spool_steps: Steps that may wait for an answer.
    """

    label: str
    connect: str
    run: str
    num_envs: int | None
    spool_steps: int

    def to_json(self) -> str:
        """Write it as one line."""
        return json.dumps(asdict(self))


def main() -> int:
    """Run one actor until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor hears Ctrl-C and stops us
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(message)s")
    task = Task(**json.loads(sys.stdin.readline()))
    tally = Tally()
    stopped = threading.Event()
    threading.Thread(target=_stop_at_end_of, args=(sys.stdin, stopped), daemon=True).start()

    def report() -> None:
        try:
            sys.stdout.write(json.dumps(tally.snapshot()) + "\n")
            sys.stdout.flush()
        except BrokenPipeError:
            stopped.set()

    report()
    try:
        _act(task, tally, stopped, report)
    except A2SError as error:
        if stopped.is_set():
            return 0
        sys.stderr.write(f"actor {task.label}: {error}\n")
        return EXIT_HOPELESS if isinstance(error, RefusedError | UsageError) else EXIT_FAILED
    finally:
        report()
    return 0


def _act(task: Task, tally: Tally, stopped: threading.Event, report: Callable[[], None]) -> None:
    name = f"{task.label}-{uuid.uuid4().hex[:8]}"
    with closing(ZenohBus.connect(task.connect, lambda: not stopped.is_set())) as bus:
        Actor(
            name=name,
            bus=bus,
            run=task.run,
            num_envs=task.num_envs,
            spool_steps=task.spool_steps,
            tally=tally,
            stopped=stopped,
            report=report,
        ).run()


def _stop_at_end_of(stream: TextIO, stopped: threading.Event) -> None:
    while stream.readline():
        pass
    stopped.set()


if __name__ == "__main__":
    sys.exit(main())
