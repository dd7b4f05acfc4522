"""``a2s learner``: one learner of one run, with actors."""

import json
import logging
import secrets
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import torch
import typer

from a2s.actors.description import Describing
from a2s.actors.description import Description as Described
from a2s.commands.process import (
    LEARNER_METRICS_PORT,
    Stop,
    cores_here,
    log_warnings,
    outlast_streams,
    serve_on,
    stop_on_signals,
)
from a2s.learner.learner import Learner
from a2s.learner.make import make_learner
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.processes import Processes, joined
from a2s.learner.run import directory as run_directory
from a2s.learner.run.choice import remove_traces
from a2s.learner.run.config import Configuration, Hyper
from a2s.learner.run.memory import keep_freed_memory, require_room
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import make_view
from a2s.learner.run.run_config import COUNTED, RunConfig
from a2s.learner.run.writing import write_atomically
from a2s.protocol.access import ACTOR
from a2s.protocol.endpoint import check_endpoint
from a2s.protocol.errors import A2SError, UsageError
from a2s.protocol.generations import MARK_BITS
from a2s.protocol.identity import Security, is_local
from a2s.protocol.keys import DEFAULT_ENDPOINT, Keys
from a2s.protocol.serving import url_of
from a2s.protocol.zenoh_bus import ZenohBus

logger = logging.getLogger(__name__)
_POLL_S = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where a learner works and how it shows its progress.

    Attributes:
        path: Directory of the run.
        resume: Go on with the run in ``path``.
        metrics_host: Address on which metrics are served.
        metrics_port: The port; 0: any free one, -1: not served, ``None``: the usual one.
        as_json: Print the summary as the last line of standard output, and all else elsewhere.
        again: The command that goes on with the run.
    """

    path: Path
    resume: bool
    metrics_host: str
    metrics_port: int | None
    as_json: bool
    again: str

    @property
    def out(self) -> TextIO:
        """Stream for the user."""
        return sys.stderr if self.as_json else sys.stdout

    @contextmanager
    def opened(
        self, run: RunConfig
    ) -> Iterator[tuple[Stop, LearnerMetrics, str, Processes | None]]:
        """Claim the directory, serve metrics (at the address given) and stop on signals.

        Other processes of torchrun are met, and share the work where they can.
        """
        metrics, host = LearnerMetrics(), self.metrics_host
        identity = {"run": run.run, "env_id": run.env, "algo": run.algo, "seed": str(run.seed)}
        metrics.run.info(identity)
        with ExitStack() as stack:
            stop, url = stack.enter_context(stop_on_signals()), "off"
            if self.metrics_port != -1:
                port = serve_on(
                    self.metrics_port,
                    LEARNER_METRICS_PORT,
                    lambda number: stack.enter_context(metrics.served(host, number)),
                )
                url = url_of(host, port, "/metrics")
            stack.enter_context(run_directory.claimed(self.path))
            processes = stack.enter_context(joined())
            if processes is not None and (run.variant != "off-policy" or run.device != "cpu"):
                logger.warning(
                    "torchrun: %d processes were started, one learns: others can help off-policy "
                    "on the cpu alone", processes.count,
                )  # fmt: skip
                processes = None
            yield stop, metrics, url, processes

    def write_config(self, configuration: Configuration) -> None:
        """Write it only once the run can go on with it: an existing one is resumed by default."""
        text = configuration.to_toml()
        write_atomically(self.path / run_directory.CONFIG, text.encode())

    def write_endpoint(self, endpoint: str) -> None:
        """Write down where the learner listens, for ``a2s status``."""
        kind, _, place = endpoint.partition("/")
        if kind == "unixsock-stream":
            endpoint = f"{kind}/{Path(place).absolute()}"
        write_atomically(self.path / run_directory.ENDPOINT, endpoint.encode())

    def run(self, learner: Learner, stop: Stop) -> dict[str, Any]:
        """Run a learner until it is done or stopped; gives the summary."""
        if learner.done:
            typer.echo(f"nothing to do: {learner.done}", self.out)
        return learner.run(stop.is_set)

    def end(self, summary: dict[str, Any], stop: Stop) -> int:
        """Say how to go on, print the summary if it is wanted as JSON, and give the exit code."""
        if not summary["finished"]:
            typer.echo(f"stopped     go on with: {self.again}", self.out)
        if self.as_json:
            typer.echo(json.dumps(summary))
        return stop.exit_code


def learn(
    configuration: Configuration,
    place: Place,
    describing: Describing,
    listen: str | None,
    security: Security,
) -> int:
    """Run a learner to its end.

    Returns:
        The exit code.

    Raises:
        A2SError: The user asked for something impossible, or the run cannot go on.
    """
    run, endpoint = configuration.run, security.endpoint(listen or DEFAULT_ENDPOINT)
    check_endpoint(endpoint)
    identity = security.listener(Keys(run.run), endpoint)
    described, stop = prepare(configuration, describing, place.out)
    if described is None:
        return stop.exit_code
    with (
        closing(ZenohBus.listen(endpoint, identity)) as bus,
        place.opened(run) as (stop, metrics, url, processes),
    ):
        typer.echo(_banner(run, place.path, endpoint, security, url), place.out)
        title = f"{run.run}: {run.algo} on {run.env}"
        with closing(make_view(title, quiet=place.as_json)) as view:
            try:
                learner = make_learner(
                    configuration=configuration,
                    spaces=described.spaces,
                    layout=described.layout,
                    episode_limit=described.episode_limit,
                    bus=bus,
                    path=place.path,
                    metrics=metrics,
                    view=view,
                    resume=place.resume,
                    mark=secrets.randbits(MARK_BITS),
                    processes=processes,
                )
            except A2SError:
                remove_traces(place.path)
                raise
            place.write_config(configuration)
            place.write_endpoint(endpoint)
            summary = place.run(learner, stop)
        typer.echo(
            f"{summary['env_steps']:,} steps in {summary['wall_s']:.0f} s, "
            f"{summary['episodes']:,} episodes, {summary['updates']:,} {COUNTED[run.variant]}, "
            f"{summary['recoveries']} recoveries",
            place.out,
        )
        if summary["stopped_at_return"]:
            best = summary["evaluation_best"]
            typer.echo(
                f"good        an evaluation of {best['mean']:.1f} at {best['env_steps']:,} steps "
                f"was --stop-at-return {run.stop_at_return:g} or more",
                place.out,
            )
        if summary["updates"]:
            typer.echo(f"policy      {place.path / 'latest' / 'policy.onnx'}", place.out)
    return place.end(summary, stop)


def prepare(
    configuration: Configuration, describing: Describing, out: TextIO
) -> tuple[Described | None, Stop]:
    """Wait for the description and load what an update calls; ``None`` if that was interrupted."""
    run = configuration.run
    prepare_process(run)
    with stop_on_signals() as stop:
        described = describing.result(lambda: not stop.is_set())
        if described is not None:
            require_room(configuration.hyper, described.spaces)
            _compile(configuration.hyper, out, stop)
    return None if stop.interrupted else described, stop


def _compile(hyper: Hyper, out: TextIO, stop: Stop) -> None:
    """Load what an update calls; on a new machine that takes a while, and is said."""
    announced = "compiling what the learner computes: once, in about {}"
    # Half a second of imports each: only who needs them.
    if isinstance(hyper, OffPolicyConfig):
        from a2s.learner.off_policy import warm_up as off_policy_warm_up

        if not off_policy_warm_up.is_compiled():
            typer.echo(announced.format("ten seconds"), out)
            _compile_elsewhere(off_policy_warm_up.__name__, repr(hyper.precision), stop)
        if not stop.is_set():
            off_policy_warm_up.warm_up(hyper.precision)
    elif isinstance(hyper, OnPolicyConfig):
        from a2s.learner.on_policy import warm_up as on_policy_warm_up

        if not on_policy_warm_up.is_compiled():
            typer.echo(announced.format("half a minute"), out)
            _compile_elsewhere(on_policy_warm_up.__name__, "", stop)
        if not stop.is_set():
            on_policy_warm_up.warm_up()


def _compile_elsewhere(module: str, argument: str, stop: Stop) -> None:
    """Compile in another process, so that this one loads what is kept, as all later ones do.

    Where loops are compiled, they call others as these were compiled for themselves; where they are
    loaded, their own copies of these. The two round differently. If it fails, they are compiled
    here. It ends at once when this process is to stop.
    """
    with subprocess.Popen(
        [sys.executable, "-c", f"from {module} import warm_up; warm_up({argument})"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
    ) as process:
        while process.poll() is None:
            if stop.is_set():
                process.kill()
            time.sleep(_POLL_S)


def prepare_process(run: RunConfig) -> None:
    """Configure the whole process: its log, and how torch uses cores and memory."""
    outlast_streams()
    log_warnings()
    if run.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device: found cuda, expected cpu: torch finds no GPU that it can use")
    cores = cores_here()
    if run.threads > cores:
        raise UsageError(f"threads: found {run.threads}, expected at most the {cores} cores here")
    torch.set_num_threads(run.threads)
    keep_freed_memory()


def _banner(run: RunConfig, path: Path, endpoint: str, security: Security, metrics_url: str) -> str:
    there = endpoint.replace("/0.0.0.0:", "/HOST:").replace("/[::]:", "/HOST:")
    connect = "" if endpoint == DEFAULT_ENDPOINT else f" --connect {there}"
    name = "" if run.run == "default" else f" --run {run.run}"
    name += "".join(f" --allow-env {shlex.quote(code)}" for code in run.env_config().code)
    if security.tls is not None:
        # The folder of the authority has one for actors in it.
        connect += f" --tls {security.tls if (Path(security.tls) / ACTOR).is_dir() else 'DIR'}"
    elif security.password_file is not None:
        connect += " --password-file FILE"
    loud = "" if security.tls is not None or is_local(endpoint) else (
        "\n  WARNING     this is not loopback and not encrypted: use it on trusted networks only"
    )  # fmt: skip
    evaluated = f"\n  evaluate it a2s actor --evaluate{connect}{name}" if run.evaluate_every else ""
    page = "" if metrics_url == "off" else f"  live page   {metrics_url.removesuffix('metrics')}\n"
    return (
        f"a2s learner: {run.algo} {run.variant} on {run.env}, preset {run.preset}, "
        f"seed {run.seed}, {run.total_steps:,} steps\n"
        f"  listens on  {endpoint}{loud}\n"
        f"  metrics     {metrics_url}\n{page}"
        f"  run         {path}\n"
        f"  join it     a2s actor --n {run.n}{connect}{name}{evaluated}"
    )
