"""``a2s train``: the learner and the actors of this machine, in one command.

It starts the same two programs that a user would start in two terminals, ends the actors when the
learner has ended, then evaluates the policy and draws the curve.
"""

import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, TextIO

import typer

from a2s.commands.evaluate import evaluate_run
from a2s.commands.options import VARIABLES
from a2s.commands.plot import plot
from a2s.commands.process import (
    EXIT_FAILED,
    SIGNALS,
    Stop,
    cores_here,
    exit_code,
    free_endpoint,
    outlast_streams,
    stop_on_signals,
)
from a2s.learner.numerals import written
from a2s.learner.run import directory as run_directory
from a2s.learner.run.choice import remove_traces
from a2s.learner.run.config import Configuration
from a2s.learner.run.writing import writing
from a2s.protocol import passwords
from a2s.protocol.access import ACTOR
from a2s.protocol.endpoint import check_endpoint
from a2s.protocol.errors import A2SError, UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys

_POLL_S = 0.05
_STOP_S = 30.0
_ENVS, _MOST_ACTORS = 16, 8
_NICENESS = 5  # of actors: where there are more threads than cores, the learner's come first
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG
ACTORS_LOG, EVALUATOR_LOG = "actors.log", "evaluator.log"

PROGRAM: tuple[str, ...] = (sys.executable, "-P", "-m", "a2s.start")
Process = subprocess.Popen[bytes]


def actors_for(cores: int) -> dict[str, int]:
    """Actor processes, and environments in each: sixteen in all, so that learning is the same.

    As many processes as cores, up to eight: two of eight are 1.2 to 1.6 times as fast as one of
    sixteen on two cores, though the learner uses both (benchmarks/speed).
    """
    n = 1
    while 2 * n <= min(cores, _MOST_ACTORS):
        n *= 2
    return {"n": n, "envs": _ENVS // n}


def train(
    configuration: Configuration,
    path: Path,
    *,
    listen: str | None,
    security: Security,
    metrics_port: int | None,
    metrics_host: str,
    fast_envs: bool,
    resume: bool,
    as_json: bool,
    again: str,
    evaluation: dict[str, Any],
) -> int:
    """Train, evaluate, plot, and say where everything is.

    The learner listens on a free port of this machine where ``listen`` is ``None``; the actors
    serve their metrics on a free port. ``fast_envs`` is theirs, ``metrics_host`` of both;
    ``evaluation`` has the arguments of `evaluate_run`.
    ``as_json`` prints the summary as the last line of standard output, and all else elsewhere.
    ``again`` is the command that goes on with the run.

    Returns:
        The exit code.

    Raises:
        A2SError: The user asked for something impossible, or learner or actors failed.
    """
    run = configuration.run
    outlast_streams()
    out = sys.stderr if as_json else sys.stdout
    endpoint = security.endpoint(listen or free_endpoint())
    check_endpoint(endpoint)
    security.listener(Keys(run.run), endpoint)
    security.peer(ACTOR)
    # Without a name: nothing is left of it, however this process ends.
    with tempfile.TemporaryFile("w+") as config, stop_on_signals() as stop:
        config.write(configuration.to_toml())
        config.flush()
        learner = ["learner", "--config", f"/dev/fd/{config.fileno()}", "--run-dir", str(path)]
        learner += ["--listen", endpoint, *security.words(), "--again", again]
        learner += ["--metrics-host", metrics_host, *(["--resume"] if resume else [])]
        learner += [] if metrics_port is None else ["--metrics-port", str(metrics_port)]
        actor = ["actor", "--n", str(run.n), "--run", run.run, "--connect", endpoint]
        actor += [word for code in run.env_config().code for word in ("--allow-env", code)]
        actor += replace(security, insecure=False).words()
        actor += [] if fast_envs else ["--no-fast-envs"]
        actor += ["--metrics-port", "-1" if metrics_port == -1 else "0"]
        actor += ["--metrics-host", metrics_host]
        evaluator = [*actor, "--n", "1", "--evaluate"] if run.evaluate_every else []
        starting = started(learner, out, files=(config.fileno(),))
        each = f"{run.envs} environment{'s' if run.envs > 1 else ''}"
        processes = f"{run.n} process{'es' if run.n > 1 else ''}"
        typer.echo(f"a2s train: {processes} of {each} beside a learner, {cores_here()} cores", out)
        code = _run(starting, actor, evaluator, path, again, stop)
    is_stopped = code in map(exit_code, SIGNALS)
    if (code and not is_stopped) or not (path / "summary.json").exists():
        return stop.exit_code or code or EXIT_FAILED
    summary = json.loads((path / "summary.json").read_text())
    failure: A2SError | None = None
    if summary["finished"] and not stop.interrupted and not is_stopped:
        try:
            with stop_on_signals() as stop:
                summary["evaluation"] = _evaluate(path, evaluation, out, stop)
            run_directory.write_summary(path, summary)
        except A2SError as error:
            failure = error
    _show(summary, path, out)
    if as_json:
        typer.echo(json.dumps(summary))
    if failure is not None:
        raise A2SError(f"the policy was not evaluated: {failure}")
    return stop.exit_code or code


def _run(
    starting: AbstractContextManager[Process],
    actor_options: list[str],
    evaluator_options: list[str],
    path: Path,
    again: str,
    stop: Stop,
) -> int:
    """Start all, wait for the learner, end the others. Learner and actors end each other.

    An evaluator that fails is missed and no more; without options there is none.

    Returns:
        The exit code of the learner: 0, that of a signal, or that of one that could not begin, and
        has said why.
    """
    with run_directory.claimed(path):
        pass  # refused here, before anything is started, if the learner could not claim it
    log, before = path / ACTORS_LOG, _starts(path)
    with ExitStack() as stack:
        learner = stack.enter_context(starting)
        with writing(log):
            actor_log = stack.enter_context(log.open("a"))
        actors = stack.enter_context(started(actor_options, actor_log, niceness=_NICENESS))
        evaluator: Process | None = None
        if evaluator_options:
            with writing(path / EVALUATOR_LOG):
                other_log = stack.enter_context((path / EVALUATOR_LOG).open("a"))
            evaluator = stack.enter_context(
                started(evaluator_options, other_log, niceness=_NICENESS)
            )
        _wait(learner, actors, evaluator, path, stop, lambda: _starts(path) != before)
    try:
        with run_directory.claimed(path):
            remove_traces(path, ACTORS_LOG, EVALUATOR_LOG)
    except A2SError:  # another learner is at work there
        if learner.returncode > 0:
            return learner.returncode
    # A learner that is still starting, or whose work is done, ends at once.
    if stop.interrupted and learner.returncode == -signal.SIGTERM:
        return stop.exit_code
    is_in_order = learner.returncode in (0, *map(exit_code, SIGNALS))
    if is_in_order or (_starts(path) == before and learner.returncode > 0):
        return learner.returncode
    code, number = learner.returncode, _signal_of(learner)
    how = f"was ended by {signal.Signals(number).name}" if number else f"ended with code {code}"
    raise A2SError(f"the learner {how}; go on from its checkpoint with: {again}")


def _starts(path: Path) -> bytes:
    """Read the file that every start of a learner changes."""
    count = path / "generation"
    return count.read_bytes() if count.is_file() else b""


def _wait(
    learner: Process,
    actors: Process,
    evaluator: Process | None,
    path: Path,
    stop: Stop,
    has_begun: Callable[[], bool],
) -> None:
    while learner.poll() is None:
        if stop.wait(_POLL_S):
            return
        # Of a mistake that keeps both from beginning, the learner says it better.
        if actors.poll() is not None and has_begun():
            log = path / ACTORS_LOG
            raise A2SError(f"{_why(actors, log)}; the actors ended, see {log}")
        if evaluator is not None and evaluator.poll() is not None:
            log = path / EVALUATOR_LOG
            why, evaluator = _why(evaluator, log), None
            typer.echo(
                f"{why}; the evaluator ended, see {log}; training goes on without it", err=True
            )


def _why(process: Process, log: Path) -> str:
    """Say why a process has ended: by a signal, or with its last words, if it had any."""
    if number := _signal_of(process):
        return f"process {process.pid} was ended by {signal.Signals(number).name}"
    lines = log.read_text(errors="replace").strip().splitlines()
    words = next((x for x in reversed(lines) if x.startswith("a2s: ")), "")
    return words.removeprefix("a2s: ") or f"exit code {process.returncode} without last words"


def _signal_of(process: Process) -> int:
    """The signal that has ended a process, at once or in order; 0: none."""
    code = process.returncode
    return -code if code < 0 else next((each for each in SIGNALS if exit_code(each) == code), 0)


@contextmanager
def started(
    options: list[str], out: IO[str], *, niceness: int = 0, files: tuple[int, ...] = ()
) -> Iterator[Process]:
    """Run a command as long as the block lasts, in a process group of its own.

    It shares the open ``files``, and is told by ``options`` alone: variables are of the command
    that the user has called. It has no password but that of a file: a learner without users refuses
    one. Ctrl-C reaches only this process, which ends it cleanly.
    """
    libc = ctypes.CDLL(None)
    left_out = {*VARIABLES, passwords.VARIABLE}

    def begin() -> None:
        libc.prctl(_DIE_WITH_PARENT, signal.SIGTERM)
        os.nice(niceness)

    process = subprocess.Popen(
        [*PROGRAM, *options],
        stdout=out,
        stderr=subprocess.STDOUT if out.name.endswith(".log") else None,
        process_group=0,
        pass_fds=files,
        env={name: value for name, value in os.environ.items() if name not in left_out},
        preexec_fn=begin,
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(timeout=_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _evaluate(
    path: Path, evaluation: dict[str, Any], out: TextIO, stop: Stop
) -> dict[str, Any] | None:
    typer.echo(
        f"evaluating {evaluation['episodes']} episodes, {evaluation['mode']} action ...", out
    )
    result = evaluate_run(path, {}, **evaluation, proceed=lambda: not stop.is_set())
    shown = ("mode", "weights", "episodes", "mean", "std", "info_metrics")
    return {name: result[name] for name in shown} if result else None


def _show(summary: dict[str, Any], path: Path, out: TextIO) -> None:
    lines, run = [], shlex.quote(str(path))
    if result := summary.get("evaluation"):
        lines.append(
            f"evaluation: {written(result['mean'])} +- {written(result['std'])} "
            f"over {result['episodes']} episodes ({result['mode']}, {result['weights']} weights)"
        )
    if dropped := summary.get("dropped_transitions"):
        lines.append(
            f"dropped     {dropped:,} steps whose numbers could not be used; 'trouble' in "
            f"{path / 'events.jsonl'} says which"
        )
    try:
        plot([path], path / "curves.png")
        lines.append(f"curve       {path / 'curves.png'}")
    except UsageError as error:
        lines.append(f"no curve: {error}")
    lines += [f"everything  {path}", f"again       a2s evaluate {run} --episodes 10"]
    lines += [f"video       a2s record {run} -o video.mp4", f"share       a2s export {run}"]
    typer.echo("\n".join(lines), out)
