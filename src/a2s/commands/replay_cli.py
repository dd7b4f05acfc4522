"""The command line of ``a2s replay``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from a2s.commands import options
from a2s.commands.options import option, whole_number
from a2s.protocol.identity import Security

app = typer.Typer(no_args_is_help=True, help="Look into a replay; export or import one.")

Stored = Annotated[
    Path | None, typer.Argument(help="A run directory, or the replay directory in it.")
]
Served = Annotated[
    str | None,
    option(None, "--connect", show_envvar=True, help="Ask the learner that listens here."),
]


@app.command()
def info(
    run_dir: Stored = None,
    connect: Served = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    run: options.Run = None,
    json_: options.Json = False,
) -> None:
    """Say what a replay holds: of a run directory, or of a running learner."""
    from a2s.commands import replay

    found = replay.info(run_dir, connect, Security(tls, password_file), run or "default")
    lines = [f"{name:<13}{value}" for name, value in found.items()]
    typer.echo(json.dumps(found) if json_ else "\n".join(lines))


@app.command()
def sample(
    run_dir: Stored = None,
    connect: Served = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    run: options.Run = None,
    batch_size: Annotated[
        int,
        whole_number(None, "--batch-size", low=1, high=4096, envvar=None, help="Transitions."),
    ] = 256,
    seed: options.Seed = None,
    n_step: Annotated[
        int,
        whole_number(None, "--n-step", low=1, high=64, envvar=None, help="Steps of each, at most."),
    ] = 1,
    gamma: Annotated[float, typer.Option(min=0.0, max=1.0, help="Discount of a step.")] = 0.99,
    prioritised: Annotated[
        bool, typer.Option("--prioritised", help="Draw by priority, not uniformly.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the arrays there, as .npz.")
    ] = None,
    json_: options.Json = False,
) -> None:
    """Draw a batch of transitions; the same seed draws the same while nothing is inserted."""
    from a2s.commands import replay

    batch = replay.sample(
        run_dir, connect, Security(tls, password_file), run or "default", batch_size, seed or 0,
        n_step=n_step, gamma=gamma, prioritised=prioritised,
    )  # fmt: skip
    arrays = replay.as_arrays(batch)
    if output is not None:
        replay.write(arrays, output)
    if json_:
        typer.echo(json.dumps({name: array.tolist() for name, array in arrays.items()}))
        return
    for name, array in arrays.items():
        low, high, mean = array.min(), array.max(), array.mean()
        typer.echo(f"{name:<9}{array.shape!s:<12} {low:.4g} to {high:.4g}, mean {mean:.4g}")


@app.command()
def export(
    run_dir: Annotated[
        Path, typer.Argument(help="A run directory, or the replay directory in it.")
    ],
    dataset: Annotated[str, typer.Argument(help="Name of the data set, for example hopper-v0.")],
    root: Annotated[
        Path | None,
        option(
            None, "--root", show_envvar=True, show_default="Minari's own", help="Where to keep it."
        ),
    ] = None,
    json_: options.Json = False,
) -> None:
    r"""Write whole episodes as a Minari data set, for `minari.load_dataset`.

    Episodes of which not all steps are there are left out and counted: those whose beginning was
    evicted, with a segment lost, not over yet, or short and left before their end. Needs
    a2s\[minari].
    """
    from a2s.commands.minari_export import export as write
    from a2s.learner.replay import directory

    found = write(directory.find(run_dir), dataset, root)
    if json_:
        typer.echo(json.dumps(found))
        return
    typer.echo(
        f"{found['path']}: {found['episodes']} episodes, {found['steps']} steps; "
        f"{found['left_out']} episodes are not whole and were left out"
    )
    if found["no_env_spec"]:
        typer.echo(f"the environment's spec is not kept in it: {found['no_env_spec']}")


@app.command("import")
def import_(
    source: Annotated[
        str,
        typer.Argument(help="A Minari data set, by its name or directory; or a run directory."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="New directory.")],
    limit: Annotated[
        int | None,
        whole_number(
            None, "--limit", low=1, envvar=None, show_default="all", help="Keep the last N only."
        ),
    ] = None,
    env: Annotated[
        str | None,
        option(
            None,
            "--env",
            envvar=None,
            metavar="ENV",
            show_default="as it says",
            help="Name that the run gives to the environment.",
        ),
    ] = None,
    json_: options.Json = False,
) -> None:
    r"""Write transitions as prior data, for `a2s train --variant off-policy --prior DIR`.

    Nothing is written where one of them cannot be learned from: every number must be finite, every
    action within the bounds. Minari data sets need a2s\[minari].
    """
    from a2s.commands.replay_import import write

    found = write(source, output, limit, env)
    line = f"{found['path']}: {found['transitions']:,} transitions of {found['env']} from {source}"
    typer.echo(json.dumps(found) if json_ else line)
