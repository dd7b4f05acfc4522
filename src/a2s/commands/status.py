"""``a2s status``: one look at a live run, or one after the other."""

import json
import math
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any

import typer

from a2s.learner.numerals import written
from a2s.learner.run import config as configuration
from a2s.learner.run import directory as run_directory
from a2s.learner.run.run_config import COUNTED
from a2s.protocol.access import ACTOR, LEARNER, VIEWER
from a2s.protocol.codec import decode
from a2s.protocol.endpoint import from_here
from a2s.protocol.errors import UnreachableError
from a2s.protocol.generations import start_of
from a2s.protocol.identity import Security, not_heard
from a2s.protocol.keys import Keys, other_runs
from a2s.protocol.messages import ActorStatus, RunStatus
from a2s.protocol.transport import Bus
from a2s.protocol.zenoh_bus import ZenohBus

_TIMEOUT_S = 5.0
_EVERY_S = 1.0
_CLEAR = "\x1b[H\x1b[2J"


def status(
    run: str,
    connect: str,
    security: Security,
    *,
    watch: bool,
    as_json: bool,
    stop: threading.Event,
) -> None:
    """Print what the learner of a run tells of it; with ``watch`` every second, while it is there.

    Raises:
        UnreachableError: Nobody listens there, or the run has another name.
    """
    keys = Keys(run)
    is_terminal = typer.get_text_stream("stdout").isatty()
    connect, identity = security.endpoint(connect), security.peer(VIEWER, LEARNER, ACTOR)
    with closing(ZenohBus.connect(connect, lambda: False, identity)) as bus:
        told = ask(bus, keys)
        if told is None:
            is_up = not_heard("is its learner up", identity.name)
            hint = other_runs(bus, run) or f"; name another with --run: {is_up}"
            raise UnreachableError(f"{connect}: no answer for run {run!r}{hint}")
        while not stop.is_set():
            text = json.dumps(_as_json(told)) if as_json else "\n".join(page(told))
            typer.echo(f"{_CLEAR if watch and is_terminal and not as_json else ''}{text}")
            if not watch or told.env_steps >= told.total_steps:
                return
            stop.wait(_EVERY_S)
            told = ask(bus, keys)
            if told is None:
                typer.echo(f"run {run}: its learner has gone", err=True)
                return


def where(directory: Path) -> tuple[str, str]:
    """The name of the run in a directory, and where its learner is reached.

    Raises:
        UsageError: It is not the directory of a run with actors.
    """
    options, _ = configuration.read(directory / run_directory.CONFIG)
    return str(options.get("run", "default")), from_here(run_directory.endpoint(directory))


def page(told: RunStatus) -> Iterator[str]:
    """Write a status as lines for a reader."""
    done = told.env_steps / told.total_steps
    line = f"run {told.run}  {told.env_id}  "
    line += f"{told.env_steps:,} of {told.total_steps:,} steps ({done:.0%})"
    if told.env_steps_per_s > 0:
        left_s = round(max(0, told.total_steps - told.env_steps) / told.env_steps_per_s)
        line += f"  {told.env_steps_per_s:,.0f} steps/s  {timedelta(seconds=left_s)} left"
    yield line
    mean = "-" if math.isnan(told.return_mean) else written(told.return_mean)
    yield (
        f"return {mean}  episodes {told.episodes:,}  "
        f"{COUNTED.get(told.variant, 'updates')} {told.updates:,}  "
        f"version {told.weights_version}  recoveries {told.epoch}"
    )
    if told.evaluation_steps:
        yield f"evaluation {written(told.evaluation_return)} at {told.evaluation_steps:,} steps"
    if told.limited_by:
        yield f"limited by {told.limited_by}"
    if told.waiting_for:
        yield f"waiting for {told.waiting_for}"
    yield from _table([_HEAD, *(_row(told, actor) for actor in told.actors)])
    for actor in told.actors:
        if actor.doing and not actor.doing.endswith(" for 0 s"):
            yield f"{actor.actor}: {actor.doing}"
        if actor.trouble:
            yield f"{actor.actor}: {actor.trouble} ({actor.dropped_steps:,} steps dropped so far)"


_HEAD = ("actor", "slot", "behind", "steps", "episodes", "unanswered", "stepping", "choosing")


def _row(told: RunStatus, actor: ActorStatus) -> tuple[str, ...]:
    spent_s = actor.environment_s + actor.selection_s + actor.sending_s + actor.waiting_s
    parts = (actor.environment_s, actor.selection_s)
    shares = (f"{part / spent_s:.0%}" if spent_s > 0 else "-" for part in parts)
    behind = max(0, told.weights_version - actor.weights_version)
    unanswered = max(0, actor.segments_sent - actor.segments_answered)
    numbers = (actor.slot, behind, actor.env_steps, actor.episodes, unanswered)
    return (actor.actor, *(f"{number:,}" for number in numbers), *shares)


def _table(rows: list[tuple[str, ...]]) -> Iterable[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [first.ljust(widths[0])]
        cells += [cell.rjust(w) for cell, w in zip(others, widths[1:], strict=True)]
        yield "  ".join(cells).rstrip()


def ask(bus: Bus, keys: Keys) -> RunStatus | None:
    """Ask the learner of a run; ``None``: no answer.

    Raises:
        MalformedMessageError: It is of another protocol.
    """
    answer = bus.ask(keys.status, b"", _TIMEOUT_S)
    told = None if answer is None else decode(answer, RunStatus)
    assert told is None or isinstance(told, RunStatus)
    return told


def _as_json(told: RunStatus) -> dict[str, Any]:
    found: dict[str, Any] = asdict(told)
    found["generation"] = start_of(told.generation)
    found["return_mean"] = None if math.isnan(told.return_mean) else told.return_mean
    return found
