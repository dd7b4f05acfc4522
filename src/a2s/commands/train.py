"""``a2s train``: the learner and the actors of this machine, in one command.

It starts the same two programs that a user would start in two terminals, ends the actors when the
learner has ended, then evaluates the policy and draws the curve.
"""

import ctypes
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

from a2s.commands.evaluate import evaluate_run
from a2s.commands.plot import plot
from a2s.commands.serving import free_endpoint
from a2s.commands.stopping import EXIT_INTERRUPTED, Stop, stop_on_signals
from a2s.learner.numerals import written
from a2s.learner.run import directory as run_directory
from a2s.learner.run.config import Configuration
from a2s.protocol.errors import A2SError, UsageError

_POLL_S = 0.05
_STOP_S = 30.0
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG

Process = subprocess.Popen[bytes]


def train(
    configuration: Configuration,
    path: Path,
    *,
    listen: str | None,
    metrics_port: int | None,
    resume: bool,
    as_json: bool,
    evaluation: dict[str, Any],
) -> int:
    """Train, evaluate, plot, and say where everything is.

    Args:
        configuration: Of the run.
        path: Directory of the run.
        listen: Endpoint of the learner; ``None`` takes a free port of this machine.
        metrics_port: Of the learner; the actors take a free one.
        resume: Go on with the run in ``path``.
        as_json: Print the summary as the last line of standard output, and all else elsewhere.
        evaluation: Arguments of :func:`a2s.commands.evaluate.evaluate_run`.

    Returns:
        The exit code.

    Raises:
        A2SError: The user asked for something impossible, or learner or actors failed.
    """
    run = configuration.run
    out = sys.stderr if as_json else sys.stdout
    endpoint = listen or free_endpoint()
    with tempfile.TemporaryDirectory(prefix="a2s-") as scratch, stop_on_signals() as stop:
        config = Path(scratch) / "config.toml"
        config.write_text(configuration.to_toml())
        learner = ["learner", "--config", str(config), "--run-dir", str(path)]
        learner += ["--listen", endpoint, *(["--resume"] if resume else [])]
        learner += [] if metrics_port is None else ["--metrics-port", str(metrics_port)]
        actor = ["actor", "--n", str(run.n), "--run", run.run, "--connect", endpoint]
        actor += ["--metrics-port", "-1" if metrics_port == -1 else "0"]
        code = _run(learner, actor, path, out, stop)
    if code:
        return code
    if not (path / "summary.json").exists():
        return EXIT_INTERRUPTED
    summary = json.loads((path / "summary.json").read_text())
    failure: A2SError | None = None
    if summary["finished"] and not stop.interrupted:
        try:
            with stop_on_signals() as stop:
                summary["evaluation"] = _evaluate(path, evaluation, out, stop)
            run_directory.write_summary(path, summary)
        except A2SError as error:
            failure = error
    _show(summary, path, out)
    if as_json:
        sys.stdout.write(json.dumps(summary) + "\n")
    if failure is not None:
        raise A2SError(f"the policy was not evaluated: {failure}")
    return EXIT_INTERRUPTED if stop.interrupted else 0


def _run(
    learner_options: list[str], actor_options: list[str], path: Path, out: IO[str], stop: Stop
) -> int:
    """Start both, wait for the learner, end the actors; one that fails ends the other.

    Returns:
        The exit code of a learner that could not begin, and has said why; else 0.
    """
    with run_directory.claimed(path):
        pass  # refused here, before anything is started, if the learner could not claim it
    log, before = path / "actors.log", _starts(path)
    learner = _start(learner_options, out)
    try:
        with log.open("a") as actor_log:
            actors = _start(actor_options, actor_log)
        try:
            _wait(learner, actors, log, stop)
        finally:
            _end(actors)
    finally:
        _end(learner)
    if not (path / run_directory.CONFIG).exists():
        _remove_traces(path, log)
    # One that is still starting, or whose work is done, ends at once.
    is_ended_by_us = stop.interrupted and learner.returncode == -signal.SIGTERM
    if learner.returncode in (0, EXIT_INTERRUPTED) or is_ended_by_us:
        return 0
    if _starts(path) == before and learner.returncode > 0:
        return learner.returncode
    raise A2SError(
        f"the learner ended with code {learner.returncode}; go on from its checkpoint with: "
        f"a2s train --resume --run-dir {path}"
    )


def _starts(path: Path) -> bytes:
    """Read what every start of a learner changes."""
    count = path / "generation"
    return count.read_bytes() if count.exists() else b""


def _remove_traces(path: Path, log: Path) -> None:
    """Leave no directory behind that would be taken for a run."""
    log.unlink()
    (path / "lock").unlink(missing_ok=True)
    if not any(path.iterdir()):
        path.rmdir()


def _wait(learner: Process, actors: Process, log: Path, stop: Stop) -> None:
    while learner.poll() is None:
        if stop.wait(_POLL_S):
            return
        if actors.poll() is not None:
            lines = log.read_text(errors="replace").strip().splitlines()
            words = next((x for x in reversed(lines) if x.startswith("a2s: ")), "no last words")
            raise A2SError(f"{words.removeprefix('a2s: ')}; the actors ended, see {log}")


def _start(options: list[str], out: IO[str]) -> Process:
    """Start a command in a process group of its own: Ctrl-C is for us, and we end it cleanly."""
    libc = ctypes.CDLL(None)
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "a2s.cli", *options],
        stdout=out,
        stderr=subprocess.STDOUT if out.name.endswith(".log") else None,
        process_group=0,
        preexec_fn=lambda: libc.prctl(_DIE_WITH_PARENT, signal.SIGTERM),
    )


def _end(process: Process) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _evaluate(
    path: Path, evaluation: dict[str, Any], out: IO[str], stop: Stop
) -> dict[str, Any] | None:
    out.write(f"evaluating {evaluation['episodes']} episodes, {evaluation['mode']} action ...\n")
    out.flush()
    result = evaluate_run(path, {}, **evaluation, proceed=lambda: not stop.is_set())
    shown = ("mode", "weights", "episodes", "mean", "std", "info_metrics")
    return {name: result[name] for name in shown} if result else None


def _show(summary: dict[str, Any], path: Path, out: IO[str]) -> None:
    result = summary.get("evaluation")
    if result:
        out.write(
            f"evaluation: {written(result['mean'])} +- {written(result['std'])} "
            f"over {result['episodes']} episodes ({result['mode']}, {result['weights']} weights)\n"
        )
    if dropped := summary.get("dropped_transitions"):
        out.write(
            f"dropped     {dropped:,} steps whose numbers could not be used; 'trouble' in "
            f"{path / 'events.jsonl'} says which\n"
        )
    try:
        plot([path], path / "curves.png")
        out.write(f"curve       {path / 'curves.png'}\n")
    except UsageError as error:
        out.write(f"no curve: {error}\n")
    out.write(f"everything  {path}\nagain       a2s evaluate {path} --episodes 10\n")
    out.flush()
