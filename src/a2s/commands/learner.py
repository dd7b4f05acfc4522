"""``a2s learner``: one learner of one run."""

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from a2s.actors.environment import describe
from a2s.commands.serving import serve_on
from a2s.commands.stopping import EXIT_INTERRUPTED, stop_on_signals
from a2s.learner import run_directory
from a2s.learner.configuration import Configuration
from a2s.learner.learner import Learner
from a2s.learner.metrics import LearnerMetrics
from a2s.learner.progress import make_view
from a2s.protocol.keys import DEFAULT_ENDPOINT
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
    spaces = describe(run.env)
    metrics = LearnerMetrics()
    metrics.run.info({"run": run.run, "env_id": run.env, "algo": run.algo, "seed": str(run.seed)})
    with (
        stop_on_signals() as stop,
        closing(ZenohBus.listen(endpoint)) as bus,
        _served(metrics, metrics_host, metrics_port) as metrics_url,
    ):
        config = path / run_directory.CONFIG
        run_directory.write_atomically(config, configuration.to_toml().encode())
        out = sys.stderr if as_json else sys.stdout
        out.write(_banner(configuration, path, endpoint, metrics_url))
        out.flush()
        with closing(make_view(f"{run.run}: {run.algo} on {run.env}", quiet=as_json)) as view:
            learner = Learner(
                configuration=configuration,
                spaces=spaces,
                bus=bus,
                path=path,
                metrics=metrics,
                view=view,
                resume=resume,
            )
            summary = learner.run(stop.is_set)
        out.write(
            f"{summary['env_steps']:,} steps in {summary['wall_s']:.0f} s, "
            f"{summary['episodes']:,} episodes, {summary['updates']:,} updates, "
            f"{summary['recoveries']} recoveries\n"
            f"policy      {path / 'latest' / 'policy.onnx'}\n"
        )
        out.flush()
    if as_json:
        sys.stdout.write(json.dumps(summary) + "\n")
    return EXIT_INTERRUPTED if stop.interrupted else 0


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
