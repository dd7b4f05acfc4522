"""The process of one actor, started by the supervisor: ``python -m a2s.actors.worker``."""

import signal
import sys
import traceback
import uuid
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from typing import Any

from a2s.actors.actor import Actor
from a2s.actors.children import told
from a2s.actors.environments.faults import Faults
from a2s.actors.metrics import Tally
from a2s.actors.parent import Parent
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, FaultyEnvironmentError, RefusedError, UsageError
from a2s.protocol.zenoh_bus import ZenohBus


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What a worker is told by its supervisor.

    Attributes:
        label: Place among the workers, for names and messages, for example ``host-0``.
        worker: The number in it.
        connect: Endpoint of the learner.
        run: Name of the run.
        num_envs: Environments to step; ``None`` leaves it to the learner.
        spool_steps: Steps that may wait for an answer.
        cause: Why the process before it had to be replaced; empty if none had.
    """

    label: str
    worker: int
    connect: str
    run: str
    num_envs: int | None
    spool_steps: int
    cause: str = ""

    def to_map(self) -> dict[str, Any]:
        """Give it as plain values."""
        return asdict(self)


def main() -> None:
    """Run one actor until the supervisor lets it stop; then end this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor hears Ctrl-C and stops us
    parent = Parent(sys.argv[1:])
    task, tally = Task(**parent.task), Tally()

    def report() -> None:
        parent.report({"counts": tally.snapshot()})

    env_id = ""

    def on_environment(config: EnvConfig) -> None:
        nonlocal env_id
        env_id = config.env_id
        parent.report({"env_id": config.env_id, "timeout_s": config.timeout_s})

    def on_failure(error: A2SError) -> None:
        if not parent.stopped.is_set():
            parent.report({"error": told(error), "is_hopeless": _is_hopeless(error, task, tally)})

    report()
    code = 0
    try:
        with closing(ZenohBus.connect(task.connect, lambda: not parent.stopped.is_set())) as bus:
            Actor(
                name=f"{task.label}-{uuid.uuid4().hex[:8]}",
                worker=task.worker,
                cause=task.cause,
                bus=bus,
                run=task.run,
                num_envs=task.num_envs,
                spool_steps=task.spool_steps,
                tally=tally,
                activity=parent.activity,
                stopped=parent.stopped,
                on_environment=on_environment,
                on_failure=on_failure,
                report=report,
            ).run()
    except BaseException as error:  # noqa: BLE001  # whatever it is, this process has to end
        code = 0 if parent.stopped.is_set() else 1
        if not isinstance(error, A2SError):
            with suppress(OSError):  # nobody may be there to read it
                traceback.print_exc(file=parent.stderr)  # a fault of ours: all of it is of use
            error = Faults(env_id).raised("its process", error)
        on_failure(error)  # once more, if the actor has told it; it is the same
    report()
    parent.leave(code)


def _is_hopeless(error: A2SError, task: Task, tally: Tally) -> bool:
    """Whether it would come again, so that starting another process is of no use."""
    if isinstance(error, FaultyEnvironmentError):
        never_worked = not task.cause and not tally.total("env_steps")
        return error.by_mistake or never_worked
    return isinstance(error, RefusedError | UsageError)


if __name__ == "__main__":
    main()
