"""``a2s learner``: one learner of one run."""

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from a2s.actors.description import describe
from a2s.commands.serving import pass_on, serve_on
from a2s.commands.stopping import EXIT_INTERRUPTED, Stop, stop_on_signals
from a2s.learner.ingest.batching import Source
from a2s.learner.learner import Learner
from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.replay import directory
from a2s.learner.replay.files import Description
from a2s.learner.replay.remote import RemoteReplay
from a2s.learner.replay_trainer import FromReplay
from a2s.learner.run import directory as run_directory
from a2s.learner.run.config import Configuration
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import make_view
from a2s.protocol.errors import UsageError
from a2s.protocol.keys import DEFAULT_ENDPOINT, Keys
from a2s.protocol.replay_messages import MOST_SAMPLED, MOST_STEPS, ReplayInfo
from a2s.protocol.zenoh_bus import ZenohBus

METRICS_PORT = 9464
_LOOPBACK = ("/127.", "/localhost:", "/[::1]:", "unixsock-stream/")


def learn(
    configuration: Configuration,
    path: Path,
    *,
    listen: str | None,
    metrics_host: str,
    metrics_port: int | None,
    resume: bool,
    as_json: bool,
) -> int:
    """Run a learner to its end.

    Returns:
        The exit code.

    Raises:
        A2SError: The user asked for something impossible, or the run cannot go on.
    """
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(message)s")
    run, endpoint = configuration.run, listen or DEFAULT_ENDPOINT
    _require_device(run.device)
    metrics = LearnerMetrics()
    metrics.run.info({"run": run.run, "env_id": run.env, "algo": run.algo, "seed": str(run.seed)})
    with stop_on_signals() as stop:
        described = describe(run.env_config(), pass_on, lambda: not stop.is_set())
    if described is None or stop.interrupted:
        return EXIT_INTERRUPTED
    with (
        stop_on_signals() as stop,
        closing(ZenohBus.listen(endpoint)) as bus,
        _served(metrics, metrics_host, metrics_port) as metrics_url,
        run_directory.claimed(path),
    ):
        out = sys.stderr if as_json else sys.stdout
        out.write(_banner(configuration, path, endpoint, metrics_url))
        out.flush()
        with closing(make_view(f"{run.run}: {run.algo} on {run.env}", quiet=as_json)) as view:
            learner = Learner(
                configuration=configuration,
                spaces=described.spaces,
                layout=described.layout,
                bus=bus,
                path=path,
                metrics=metrics,
                view=view,
                resume=resume,
            )
            _write_down(configuration, path)
            summary = learner.run(stop.is_set)
        out.write(
            f"{summary['env_steps']:,} steps in {summary['wall_s']:.0f} s, "
            f"{summary['episodes']:,} episodes, {summary['updates']:,} updates, "
            f"{summary['recoveries']} recoveries\n"
        )
        if summary["updates"]:
            out.write(f"policy      {path / 'latest' / 'policy.onnx'}\n")
        out.flush()
    return _end(summary, stop, as_json=as_json)


def learn_from(
    configuration: Configuration,
    path: Path,
    source: str,
    *,
    env: str | None,
    connect: str,
    metrics_host: str,
    metrics_port: int | None,
    resume: bool,
    as_json: bool,
) -> int:
    """Learn from the replay of another run, without actors.

    Args:
        configuration: Of this run; the replay says which environment it is.
        path: Directory of this run.
        source: A run directory, or the name of a run whose learner listens on ``connect``.
        env: What the user expects it to be of, if anything.
        connect: Endpoint of that learner.
        metrics_host: Where metrics are served.
        metrics_port: The port; -1: not served.
        resume: Go on with ``path``.
        as_json: End with the summary as one line.

    Returns:
        The exit code.

    Raises:
        UsageError: The variant is not off-policy, the environment another, or a batch more than
            a learner answers with.
        A2SError: The replay cannot be read or reached.
    """
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(message)s")
    if configuration.run.variant != "off-policy":
        raise UsageError("--replay-from: only --variant off-policy learns from a replay")
    _require_device(configuration.run.device)
    out, metrics = sys.stderr if as_json else sys.stdout, LearnerMetrics()
    with ExitStack() as stack:
        hyper = configuration.hyper
        assert isinstance(hyper, OffPolicyHyper)
        if not Path(source).is_dir():
            _require_askable(hyper)
        replay, about, size, most = source_of(source, connect, stack, hyper.priority_exponent)
        if env not in (None, about.env_id):
            raise UsageError(
                f"--env: found {env}, expected {about.env_id}, as the replay of {source}"
            )
        run = replace(configuration.run, env=about.env_id)
        configuration = replace(configuration, run=run)
        stop = stack.enter_context(stop_on_signals())
        url = stack.enter_context(_served(metrics, metrics_host, metrics_port))
        stack.enter_context(run_directory.claimed(path))
        learner = FromReplay(
            configuration=configuration,
            spaces=about.spaces,
            source=replay,
            size=size,
            most=most,
            path=path,
            metrics=metrics,
            resume=resume,
        )
        metrics.run.info(
            {"run": run.run, "env_id": run.env, "algo": run.algo, "seed": str(run.seed)}
        )
        _write_down(configuration, path)
        out.write(
            f"a2s learner: {run.env} from the replay of {source}, {size():,} transitions\n"
            f"  metrics     {url}\n  run         {path}\n"
        )
        out.flush()
        summary = learner.run(stop.is_set)
    policy = path / "latest" / "policy.onnx"
    out.write(
        f"{summary['updates']:,} updates in {summary['wall_s']:.0f} s\npolicy      {policy}\n"
    )
    out.flush()
    return _end(summary, stop, as_json=as_json)


def _require_askable(hyper: OffPolicyHyper) -> None:
    for name, most in {"n_step": MOST_STEPS, "batch_rows": MOST_SAMPLED}.items():
        if (found := getattr(hyper, name)) > most:
            raise UsageError(
                f"{name}: found {found}, expected at most {most} from a replay over the network; "
                "set less, or name a run directory"
            )


def _write_down(configuration: Configuration, path: Path) -> None:
    """Only once the run can go on with it: what was there before is resumed by default."""
    text = configuration.to_toml()
    run_directory.write_atomically(path / run_directory.CONFIG, text.encode())


def _require_device(device: str) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device: found cuda, expected cpu: torch finds no GPU that it can use")


def _end(summary: dict[str, Any], stop: Stop, *, as_json: bool) -> int:
    """Give the summary to whoever wants it as JSON, and the exit code."""
    if as_json:
        sys.stdout.write(json.dumps(summary) + "\n")
    return EXIT_INTERRUPTED if stop.interrupted else 0


def source_of(
    source: str, connect: str, stack: ExitStack, exponent: float
) -> tuple[Source, Description | ReplayInfo, Callable[[], int], int]:
    """Open the replay of a run.

    Args:
        source: A run directory, or the name of a run whose learner listens on ``connect``.
        connect: Endpoint of that learner.
        stack: Closes what was opened.
        exponent: Of the priorities of a directory; a learner that serves has its own.

    Returns:
        The replay, what it is, how many transitions it holds now, and at most.

    Raises:
        UsageError: The source is a path, but not that of a directory.
        A2SError: The replay cannot be read or reached.
    """
    if Path(source).is_dir():
        stored = directory.look_at(directory.find(Path(source)), alpha=exponent, alone=True)
        stack.callback(stored.close)
        return stored, stored.about, lambda: len(stored), len(stored)
    if os.sep in source:  # no name of a run has one
        raise UsageError(
            f"--replay-from: found no directory {source}; name that of a run, or a run at --connect"
        )
    bus = stack.enter_context(closing(ZenohBus.connect(connect, lambda: False)))
    remote = RemoteReplay(bus, Keys(source))

    def size() -> int:
        info = remote.info()
        return info.end - info.begin

    about = remote.info()
    return remote, about, size, about.capacity


@contextmanager
def _served(metrics: LearnerMetrics, host: str, port: int | None) -> Iterator[str]:
    """Serve metrics as long as the block lasts, and give their address."""
    if port == -1:
        yield "off"
        return
    bound, stop = serve_on(port, METRICS_PORT, lambda chosen: metrics.serve(host, chosen))
    try:
        yield f"http://{host}:{bound}/metrics"
    finally:
        stop()


def _banner(configuration: Configuration, path: Path, endpoint: str, metrics_url: str) -> str:
    run = configuration.run
    join = "a2s actor --n 2"
    if endpoint != DEFAULT_ENDPOINT:
        join += f" --connect {endpoint}"
    if run.run != "default":
        join += f" --run {run.run}"
    loud = "" if any(part in endpoint for part in _LOOPBACK) else (
        "\n  WARNING     this is not loopback and not encrypted: use it on trusted networks only"
    )  # fmt: skip
    return (
        f"a2s learner: {run.algo} {run.variant} on {run.env}, preset {run.preset}, "
        f"seed {run.seed}, {run.total_steps:,} steps\n"
        f"  listens on  {endpoint}{loud}\n"
        f"  metrics     {metrics_url}\n"
        f"  run         {path}\n"
        f"  join it     {join}\n"
    )
