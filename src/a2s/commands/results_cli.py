"""The command lines of what comes after training: policies and curves."""

import json
from pathlib import Path
from typing import Annotated

import typer

from a2s.commands import options
from a2s.commands.groups import ENVIRONMENT, taking
from a2s.commands.run_cli import require_learner


@taking(ENVIRONMENT)
def evaluate(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="A run directory, or a policy file.")],
    episodes: options.Episodes = 10,
    mode: options.Mode = "mean",
    weights: options.WhichWeights = "latest",
    seed: options.Seed = None,
    json_: options.Json = False,
) -> None:
    """Play fresh episodes with a trained policy."""
    from a2s.commands.evaluate import evaluate_run, line

    given = options.given(context, ENVIRONMENT)
    found = evaluate_run(
        run, given.typed, fallback=given.variables,
        episodes=episodes, mode=mode, weights=weights, seed=seed or 0,
    )  # fmt: skip
    typer.echo(json.dumps(found) if json_ else line(found))


@taking(ENVIRONMENT)
def record(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="A run directory, or a policy file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", envvar="A2S_OUTPUT", help="Video to write.")
    ] = Path("video.mp4"),
    episodes: options.Episodes = 1,
    mode: options.Mode = "mean",
    weights: options.WhichWeights = "latest",
    seed: options.Seed = None,
    overlay: Annotated[
        bool, typer.Option("--overlay/--no-overlay", help="Write steps, return and Q on it.")
    ] = True,
    json_: options.Json = False,
) -> None:
    """Record fresh episodes with a trained policy as a video; it needs no screen."""
    from a2s.commands.process import stop_on_signals
    from a2s.commands.record import line, record_run

    given = options.given(context, ENVIRONMENT)
    with stop_on_signals() as stop:
        found = record_run(
            run, given.typed, fallback=given.variables, output=output, episodes=episodes,
            mode=mode, weights=weights, seed=seed or 0, overlay=overlay,
            proceed=lambda: not stop.is_set(),
        )  # fmt: skip
    if not found:
        typer.echo("stopped: no video was written", err=True)
        raise typer.Exit(stop.exit_code)
    typer.echo(json.dumps(found) if json_ else line(found))


def export(
    run: Annotated[Path, typer.Argument(help="A run directory, or a policy file.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", envvar="A2S_OUTPUT", help="New folder.")
    ] = Path("policy"),
    weights: options.WhichWeights = "latest",
) -> None:
    """Write a folder with the policy that works without a2s: Python, JavaScript, a model card."""
    from a2s.commands.export import export_run

    for file in export_run(run, output, weights):
        typer.echo(file)


def plot(
    runs: Annotated[list[Path], typer.Argument(help="Run directories.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", envvar="A2S_OUTPUT", help="Picture to write.")
    ] = Path("curves.png"),
    by: Annotated[
        str, options.option(None, "--by", metavar="steps|time", help="What they are drawn over.")
    ] = "steps",
) -> None:
    """Draw learning curves: every seed light, their interquartile mean, its 95 % interval."""
    require_learner()
    from a2s.commands.plot import axis_of
    from a2s.commands.plot import plot as draw

    picture = output if output.suffix else output.with_suffix(".png")
    for reason in draw(runs, picture, axis_of(by)):
        typer.echo(f"a2s: left out: {reason}", err=True)
    typer.echo(picture)


def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run directories, the first to compare with.")],
    json_: options.Json = False,
) -> None:
    """Compare ways of learning: interquartile means over seeds, intervals, chances to be better."""
    require_learner()
    from a2s.commands.compare import compare_runs, page

    found = compare_runs(runs)
    typer.echo(json.dumps(found) if json_ else page(found))
