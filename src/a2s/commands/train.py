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

from a2s.actors.environment import describe
from a2s.commands.evaluate import evaluate_run
from a2s.commands.plot import plot
from a2s.commands.serving import free_endpoint
from a2s.commands.stopping import EXIT_INTERRUPTED, Stop, stop_on_signals
from a2s.learner import run_directory
from a2s.learner.configuration import Configuration
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
    describe(run.env)
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
        _run(learner, actor, path, out, stop)
    if not (path / "summary.json").exists():
        return EXIT_INTERRUPTED
    summary = json.loads((path / "summary.json").read_text())
    if summary["finished"] and not stop.interrupted:
        summary["evaluation"] = _evaluate(path, evaluation, out)
        run_directory.write_summary(path, summary)
    _show(summary, path, out)
    if as_json:
        sys.stdout.write(json.dumps(summary) + "\n")
    return EXIT_INTERRUPTED if stop.interrupted else 0


def _run(
    learner_options: list[str], actor_options: list[str], path: Path, out: IO[str], stop: Stop
) -> None:
    """Start both, wait for the learner, end the actors; one that fails ends the other."""
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
    if learner.returncode not in (0, EXIT_INTERRUPTED) and not is_ended_by_us:
        advice = "nothing was begun"
        if _starts(path) != before:
            advice = f"go on from its checkpoint with: a2s train --resume --run-dir {path}"
        raise A2SError(f"the learner ended with code {learner.returncode}; {advice}")


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
            words = (log.read_text().strip().splitlines() or ["no last words"])[-1]
            raise A2SError(f"the actors ended: {words} (all of it: {log})")


def _start(options: list[str], out: IO[str]) -> Process:
    """Start a command in a process group of its own: Ctrl-C is for us, and we end it cleanly."""
    libc = ctypes.CDLL(None)
    return subprocess.Popen(
        [sys.executable, "-m", "a2s.cli", *options],
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


def _evaluate(path: Path, evaluation: dict[str, Any], out: IO[str]) -> dict[str, Any]:
    out.write(f"evaluating {evaluation['episodes']} episodes, {evaluation['mode']} action ...\n")
    out.flush()
    result = evaluate_run(path, None, **evaluation)
    return {name: result[name] for name in ("mode", "weights", "episodes", "mean", "std")}


def _show(summary: dict[str, Any], path: Path, out: IO[str]) -> None:
    result = summary.get("evaluation")
    if result:
        out.write(
            f"evaluation: {result['mean']:.1f} +- {result['std']:.1f} over {result['episodes']} "
            f"episodes ({result['mode']}, {result['weights']} weights)\n"
        )
    try:
        plot([path], path / "curves.png")
        out.write(f"curve       {path / 'curves.png'}\n")
    except UsageError as error:
        out.write(f"no curve: {error}\n")
    out.write(f"everything  {path}\nagain       a2s evaluate {path} --episodes 10\n")
    out.flush()
