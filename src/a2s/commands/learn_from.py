"""``a2s learner --replay-from``: learning from the replay of another run, without actors."""

import os
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import typer

from a2s.commands.learner import Place, prepare_process
from a2s.learner.make import make_replay_learner
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.off_policy_trainer import AnyReplay
from a2s.learner.replay import directory
from a2s.learner.replay.files import Description
from a2s.learner.replay.remote import RemoteReplay
from a2s.learner.run.config import Configuration
from a2s.learner.run.progress import make_view
from a2s.protocol.access import LEARNER, VIEWER
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.replay_messages import MAX_SAMPLED, MAX_STEPS, ReplayInfo
from a2s.protocol.zenoh_bus import ZenohBus


def learn_from(
    configuration: Configuration,
    place: Place,
    source: str,
    *,
    env: str | None,
    connect: str,
    security: Security,
) -> int:
    """Learn from the replay of another run, without actors.

    The replay, ``source`` as in `source_of`, says which environment it is; ``env`` is the one
    that the user expects, if any.

    Returns:
        The exit code.

    Raises:
        UsageError: The variant is not off-policy, the environment another, or a batch more than
            a learner answers with.
        A2SError: The replay cannot be read or reached.
    """
    hyper = configuration.hyper
    if not isinstance(hyper, OffPolicyConfig):
        raise UsageError("--replay-from: only --variant off-policy learns from a replay")
    if configuration.run.evaluate_every:
        raise UsageError("--evaluate-every: found with --replay-from, which no evaluator can join")
    prepare_process(configuration.run)
    with ExitStack() as stack:
        replay, about, size, max_size = source_of(source, connect, security, stack, hyper)
        if env not in (None, about.env_id):
            raise UsageError(
                f"--env: found {env}, expected {about.env_id}, as the replay of {source}"
            )
        run = replace(configuration.run, env=about.env_id)
        configuration = replace(configuration, run=run)
        stop, metrics, url, processes = stack.enter_context(place.opened(run))
        title = f"{run.run}: {run.env}"
        view = stack.enter_context(closing(make_view(title, quiet=place.as_json)))
        learner = make_replay_learner(
            configuration=configuration,
            spaces=about.spaces,
            replay=replay,
            size=size,
            max_size=max_size,
            path=place.path,
            metrics=metrics,
            view=view,
            resume=place.resume,
            processes=processes,
        )
        place.write_config(configuration)
        typer.echo(
            f"a2s learner: {run.env} from the replay of {source}, {size():,} transitions\n"
            f"  metrics     {url}\n  run         {place.path}",
            place.out,
        )
        summary = place.run(learner, stop)
    typer.echo(f"{summary['updates']:,} gradient steps in {summary['wall_s']:.0f} s", place.out)
    typer.echo(f"policy      {place.path / 'latest' / 'policy.onnx'}", place.out)
    return place.end(summary, stop)


def source_of(
    source: str, connect: str, security: Security, stack: ExitStack, hyper: OffPolicyConfig
) -> tuple[AnyReplay, Description | ReplayInfo, Callable[[], int], int]:
    """Open the replay of a run.

    ``source`` is a run directory, or the name of a run whose learner listens on ``connect``. A
    directory is drawn from by the priority exponent of ``hyper``; a learner that serves has its
    own. ``stack`` closes all that was opened.

    Returns:
        The replay, its description, a function for the number of transitions that it holds now,
        and the most that it can hold.

    Raises:
        UsageError: The source is a path, but not that of a directory, or a batch is more than a
            learner answers with.
        A2SError: The replay cannot be read or reached.
    """
    if Path(source).is_dir():
        stored = directory.look_at(
            directory.find(Path(source)), alpha=hyper.priority_exponent, alone=True
        )
        stack.callback(stored.close)
        return stored, stored.about, lambda: len(stored), len(stored)
    if os.sep in source:  # the name of a run has none
        raise UsageError(
            f"--replay-from: found no directory {source}; name that of a run, or a run at --connect"
        )
    for name, most in {"n_step": MAX_STEPS, "batch_rows": MAX_SAMPLED}.items():
        if (found := getattr(hyper, name)) > most:
            raise UsageError(
                f"{name}: found {found}, expected at most {most} from a replay over the network; "
                "set less, or name a run directory"
            )
    endpoint, identity = security.endpoint(connect), security.peer(LEARNER, VIEWER)
    bus = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False, identity)))
    remote = RemoteReplay(bus, Keys(source))

    def size() -> int:
        info = remote.info()
        return info.end - info.begin

    about = remote.info()
    return remote, about, size, about.capacity
