"""``a2s learner`` in the second and any later process of torchrun."""

import signal

from a2s.commands.process import log_warnings, outlast_streams
from a2s.learner.off_policy_processes import follow
from a2s.learner.processes import joined
from a2s.learner.run.memory import keep_freed_memory


def follow_first() -> int:
    """Do what the first process tells, until it ends.

    Returns:
        The exit code.

    Raises:
        A2SError: The first process is gone.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the first hears them too, and still needs us
    outlast_streams()
    log_warnings()
    keep_freed_memory()
    with joined() as processes:
        if processes is not None:
            follow(processes)
    return 0
