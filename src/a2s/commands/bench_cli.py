"""The command line of ``a2s bench``."""

import json
from typing import Annotated

import typer

from a2s.commands import options, run_cli
from a2s.protocol.errors import UsageError

_LOAD = "Load of simulated actors (wire)"


def bench(
    suite: Annotated[str, typer.Argument(help="actor, learner, wire, replay or startup.")],
    rounds: Annotated[
        int,
        options.whole_number(
            None, "--rounds", low=1, envvar=None, help="Turns of every contender."
        ),
    ] = 9,
    seconds: Annotated[float, typer.Option(min=0.0, help="Of one turn, at least.")] = 0.2,
    actors: Annotated[
        int | None,
        options.whole_number(
            _LOAD,
            "--actors",
            low=1,
            envvar=None,
            help="Instead, have so many sessions send made-up segments for rounds x seconds.",
        ),
    ] = None,
    pace: Annotated[
        float,
        typer.Option(
            min=0.0,
            rich_help_panel=_LOAD,
            help="Seconds from one segment of an actor to its next; 0: once it is answered.",
        ),
    ] = 0.0,
    connect: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            rich_help_panel=_LOAD,
            help="Learner to send to; it learns from what is sent. Without it, one is started.",
        ),
    ] = None,
    run: Annotated[
        str, typer.Option(metavar="NAME", rich_help_panel=_LOAD, help="Its run.")
    ] = "default",
    json_: options.Json = False,
) -> None:
    """Measure this machine: rates beside others' in the same run, medians over the rounds."""
    run_cli.require_learner()
    from a2s.commands.bench import bench as measure
    from a2s.commands.bench import table

    if actors is None:
        if pace or connect:
            raise UsageError("bench: found --pace or --connect, expected --actors N with them")
        rows = measure(suite, rounds, seconds)
    elif suite != "wire":
        raise UsageError(f"bench {suite}: found --actors, expected it with wire only")
    else:
        from a2s.commands.bench_load import load

        rows = load(actors, connect=connect, run=run, pace_s=pace, seconds=rounds * seconds)
    typer.echo(json.dumps(rows) if json_ else table(rows))
