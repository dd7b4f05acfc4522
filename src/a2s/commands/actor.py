"""``a2s actor``: n supervised actor processes on this machine."""

import socket
from collections.abc import Sequence
from pathlib import Path

import typer

from a2s.actors.metrics import Fleet, serve
from a2s.actors.supervisor import Supervisor
from a2s.actors.task import Task
from a2s.commands.process import (
    ACTOR_METRICS_PORT,
    log_warnings,
    outlast_streams,
    serve_on,
    stop_on_signals,
)
from a2s.protocol.access import ACTOR
from a2s.protocol.endpoint import check_endpoint
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.serving import url_of


def act(
    *,
    n: int,
    envs: int | None,
    run: str,
    connect: str,
    security: Security,
    evaluates: bool,
    allow_env: Sequence[str],
    fast_envs: bool,
    outbox_steps: int,
    metrics_host: str,
    metrics_port: int | None,
) -> int:
    """Run actors, or evaluators, until interrupted.

    Returns:
        The exit code.

    Raises:
        A2SError: The user asked for something impossible, or the actors cannot work.
    """
    outlast_streams()
    log_warnings()
    Keys(run)
    for code in allow_env:
        _require_there(code)
    connect = security.endpoint(connect)
    check_endpoint(connect)
    known_as = security.peer(ACTOR).name
    host = "".join(c if c.isalnum() or c in "-_" else "-" for c in socket.gethostname())[:40]
    tasks = [
        Task(
            # Others may not speak under names that begin so (docs/security.md).
            label=f"{known_as}{'.' if known_as else ''}{host or 'host'}-{index}",
            worker=index,
            connect=connect,
            run=run,
            num_envs=envs,
            outbox_steps=outbox_steps,
            evaluates=evaluates,
            allow_env=tuple(allow_env),
            fast_envs=fast_envs,
            known_as=known_as,
            tls=security.tls,
            password_file=security.password_file,
        )
        for index in range(n)
    ]
    fleet, url = Fleet(n), "off"
    if metrics_port != -1:
        bound = serve_on(
            metrics_port, ACTOR_METRICS_PORT, lambda port: serve(fleet, metrics_host, port)
        )
        url = url_of(metrics_host, bound, "/metrics")
    role = f"{'process' if n == 1 else 'processes'} "
    role += f"that evaluate{'s' if n == 1 else ''} run" if evaluates else "for run"
    typer.echo(f"a2s actor: {n} {role} {run}")
    typer.echo(f"  connect     {connect}\n  metrics     {url}")
    with stop_on_signals() as stop:
        Supervisor(tasks, fleet).run(stop)
    return stop.exit_code


def _require_there(code: str) -> None:
    """Refuse to allow a file that is not there, as the mistake of a name that it is.

    Raises:
        UsageError: It is not.
    """
    place = code if code.endswith(".py") else code.rpartition(":")[0]
    if place.endswith(".py") and not (Path(place).is_file() or Path(Path(place).name).is_file()):
        raise UsageError(f"--allow-env: found no file {place}; name one that is there, or a module")
