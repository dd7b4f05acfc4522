"""The process of one actor, started by the supervisor: ``python -m a2s.actors.worker``."""

import signal
import sys
import traceback
from contextlib import closing, suppress

from a2s.actors.actor import Actor
from a2s.actors.environments.faults import Faults
from a2s.actors.evaluator import Evaluator
from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.parent import Parent, told
from a2s.actors.task import Task
from a2s.protocol.access import ACTOR
from a2s.protocol.errors import A2SError, FaultyEnvironmentError, RefusedError, UsageError
from a2s.protocol.identity import Security
from a2s.protocol.zenoh_bus import ZenohBus


def main() -> None:
    """Run one actor until the supervisor lets it stop; then end this process."""
    for number in (signal.SIGINT, signal.SIGHUP):  # the supervisor hears them, and stops us
        signal.signal(number, signal.SIG_IGN)
    parent = Parent(sys.argv[1:])
    task, metrics = Task(**parent.task), ActorMetrics()
    actor: Actor | Evaluator | None = None

    def on_failure(error: A2SError) -> None:
        if not parent.stopped.is_set():
            is_hopeless = _is_hopeless(error, task, metrics)
            parent.report({"error": told(error), "is_hopeless": is_hopeless})

    def waits() -> bool:
        """Report while nobody listens: the supervisor ends a worker that has become silent."""
        parent.report(metrics.report())
        return not parent.stopped.is_set()

    parent.report(metrics.report())
    code = 0
    try:
        identity = Security(task.tls, task.password_file).peer(ACTOR)
        with closing(ZenohBus.connect(task.connect, waits, identity)) as bus:
            role = Evaluator if task.evaluates else Actor
            actor = role(task, bus, metrics, parent, on_failure)
            actor.run()
    except BaseException as error:  # noqa: BLE001  # whatever it is, this process has to end
        code = 0 if parent.stopped.is_set() else 1
        if not isinstance(error, A2SError):
            with suppress(OSError):  # nobody may be there to read it
                traceback.print_exc(
                    file=parent.stderr
                )  # a fault of ours: print the whole traceback
            error = Faults(actor.env_id if actor else "").raised("its process", error)
        on_failure(error)  # once more, if the actor has told it; it is the same
    parent.report(metrics.report())
    parent.leave(code)


def _is_hopeless(error: A2SError, task: Task, metrics: ActorMetrics) -> bool:
    """Whether the error would recur, so that starting another process is useless."""
    if isinstance(error, FaultyEnvironmentError):
        worked = total(metrics.env_steps) + total(metrics.evaluations)
        never_worked = not task.cause and not worked
        return error.by_mistake or never_worked
    return isinstance(error, RefusedError | UsageError)


if __name__ == "__main__":
    main()
