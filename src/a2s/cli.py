"""The command line: parses options and calls; every command imports what it needs when it runs."""

import errno
import json
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from a2s import __version__
from a2s.commands import bench_cli, groups, options, replay_cli, results_cli, run_cli
from a2s.commands.process import (
    EXIT_FAILED,
    OutputError,
    check_streams,
    end_on_signals,
    open_standard_streams,
    outlast_streams,
)
from a2s.protocol.errors import A2SError, UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import DEFAULT_ENDPOINT

EXIT_USAGE = 2

app = typer.Typer(
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Train continuous control with many actors and one learner: the policy suggests, Q picks."
    "\n\nEvery option of a run can be given by a variable: --total-steps by A2S_TOTAL_STEPS.",
)
app.add_typer(replay_cli.app, name="replay")


def _show_version(value: bool) -> None:
    if value:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _about(
    _version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_show_version, is_eager=True, help="Show it."),
    ] = False,
) -> None:
    pass


app.command()(run_cli.learner)


@app.command()
def actor(
    n: options.N = None,
    envs: options.Envs = None,
    run: options.Run = None,
    connect: options.Connect = DEFAULT_ENDPOINT,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    evaluate: options.Evaluate = False,
    allow_env: options.AllowEnv = None,
    fast_envs: options.FastEnvs = True,
    outbox_steps: options.OutboxSteps = 65_536,
    spool_steps: options.SpoolSteps = None,
    metrics_port: options.MetricsPort = None,
    metrics_host: options.MetricsHost = options.LOOPBACK,
) -> None:
    """Start supervised actor processes that join a run; the learner tells them everything else."""
    from a2s.commands.actor import act

    raise typer.Exit(
        act(
            n=n or 1,
            envs=envs,
            run=run or "default",
            connect=connect,
            security=Security(tls, password_file),
            evaluates=evaluate,
            allow_env=allow_env or (),
            fast_envs=fast_envs,
            outbox_steps=spool_steps or outbox_steps,
            metrics_host=metrics_host,
            metrics_port=metrics_port,
        )
    )


app.command()(run_cli.train)


@app.command()
def status(
    directory: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="A run directory, instead of --run and --connect."),
    ] = None,
    run: options.Run = None,
    connect: options.MaybeConnect = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    watch: Annotated[bool, typer.Option("--watch", help="Every second, until its end.")] = False,
    json_: options.Json = False,
) -> None:
    """Look at a live run: its progress, what limits it, and what each actor does."""
    from a2s.commands.process import stop_on_signals
    from a2s.commands.status import status as look
    from a2s.commands.status import where

    if directory is not None:
        if run or connect:
            raise UsageError(f"a2s status: found {directory} and --run or --connect, expected one")
        run, connect = where(directory)
    with stop_on_signals() as stop:
        look(
            run or "default", connect or DEFAULT_ENDPOINT, Security(tls, password_file),
            watch=watch, as_json=json_, stop=stop,
        )  # fmt: skip


@app.command()
def dashboard(
    targets: Annotated[
        list[str] | None,
        typer.Argument(help="HOST:PORT of a learner's metrics, one for each run."),
    ] = None,
    port: Annotated[
        int | None,
        options.whole_number(
            None,
            "--port",
            low=0,
            high=65535,
            envvar=None,
            show_default="9466",
            help="Port of the page: 0 takes any free one.",
        ),
    ] = None,
    host: Annotated[
        str, options.option(None, "--host", help="Address on which the page is served.")
    ] = options.LOOPBACK,
) -> None:
    """Serve the live page of one or more runs, on this machine or others."""
    from a2s.commands.dashboard import show
    from a2s.commands.process import stop_on_signals

    with stop_on_signals() as stop:
        show(targets or [], host, port, stop)
    raise typer.Exit(stop.exit_code)


@app.command()
def doctor(
    run_dir: Annotated[
        Path | None,
        typer.Argument(help="A run directory to examine, instead of this machine."),
    ] = None,
    connect: Annotated[
        str | None,
        options.option(None, "--connect", metavar="ENDPOINT", help="A learner that must answer."),
    ] = None,
    run: options.Run = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    json_: options.Json = False,
) -> None:
    """Check this machine and the way to the learner, or a run; say how to mend what is wrong."""
    from a2s.commands.doctor import examine, line

    looks = examine(connect, run or "default", Security(tls, password_file))
    if run_dir is not None:
        from a2s.commands.doctor_run import examine_run

        looks = examine_run(run_dir)
    findings = []
    for finding in looks:
        findings.append(finding)
        if not json_:
            typer.echo(line(finding))
    if json_:
        typer.echo(json.dumps([finding._asdict() for finding in findings]))
    raise typer.Exit(EXIT_FAILED if any(each.state == "fail" for each in findings) else 0)


@app.command()
def certs(
    folder: Annotated[Path, typer.Argument(help="Folder of the authority.")] = Path("certs"),
    host: Annotated[
        list[str] | None,
        typer.Option(
            "--host",
            metavar="HOST",
            help="Name or address of the learner's machine; may be repeated.",
        ),
    ] = None,
    actor: Annotated[
        list[str] | None,
        typer.Option(
            "--actor", metavar="NAME", help="A certificate for some actors alone; repeatable."
        ),
    ] = None,
    viewer: Annotated[
        list[str] | None,
        typer.Option(
            "--viewer", metavar="NAME", help="A certificate for one viewer alone; repeatable."
        ),
    ] = None,
    days: Annotated[
        int,
        options.whole_number(
            None, "--days", low=1, high=3650, envvar=None, help="Days that they are valid."
        ),
    ] = 365,
) -> None:
    """Make certificates, for --tls: of the learner, of actors, and of who only looks.

    Called again it makes what is missing, and anew what expires within 30 days.
    """
    from a2s.commands.certs import make

    for line in make(folder, host or [], actor or [], viewer or [], days):
        typer.echo(line)


app.command()(results_cli.evaluate)


app.command()(results_cli.record)


app.command()(results_cli.export)


@app.command()
@groups.taking(groups.ENVIRONMENT)
def check(
    context: typer.Context,
    environment: Annotated[
        str | None, typer.Argument(help="As --env of a2s train.", metavar="ENV")
    ] = None,
    env: options.Env = None,
    json_: options.Json = False,
) -> None:
    """Try an environment: whether it can be trained on, what it is, and how fast."""
    from a2s.actors.check import check as try_out
    from a2s.commands.check import page
    from a2s.commands.configure import environment_of
    from a2s.commands.process import pass_on

    if (environment is None) == (env is None):
        raise UsageError("a2s check: name one environment, for example a2s check Hopper-v5")
    given = {**options.named(context, groups.ENVIRONMENT), "env": environment or env}
    found = try_out(environment_of(given), pass_on)
    command = shlex.join(["a2s", "train", *options.words(context, given)])
    typer.echo(json.dumps(found) if json_ else page(found, command))


app.command()(results_cli.plot)


app.command()(results_cli.compare)


app.command()(run_cli.tune)


app.command()(bench_cli.bench)


def main() -> None:
    """Run the command line; what is expected to go wrong is one line on standard error."""
    open_standard_streams()
    check_streams()
    try:
        with end_on_signals():
            try:
                app()
            finally:
                sys.stdout.flush()
    except OutputError as error:
        outlast_streams()  # what is left is written once more when Python ends
        if not error.is_closed:
            sys.stderr.write(f"a2s: {error}\n")
        sys.exit(EXIT_FAILED)
    except A2SError as error:
        sys.stderr.write(f"a2s: {error}\n")
        sys.exit(EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED)
    except PermissionError as error:
        sys.stderr.write(
            f"a2s: {error.filename}: {error.strerror}; run as a user with read and write access\n"
        )
        sys.exit(EXIT_FAILED)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        sys.stderr.write(f"a2s: {error.filename}: {error.strerror}; name a shorter one\n")
        sys.exit(EXIT_USAGE)


if __name__ == "__main__":
    main()
