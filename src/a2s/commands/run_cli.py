"""The command lines of ``a2s learner``, ``a2s train`` and ``a2s tune``."""

import importlib.util
import json
import shlex
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from a2s.commands import options
from a2s.commands.groups import ALGORITHM, ENVIRONMENT, RUN, taking
from a2s.commands.process import cores_here, pass_on
from a2s.learner.torchrun import number_and_count
from a2s.protocol.errors import UsageError
from a2s.protocol.identity import Security
from a2s.protocol.keys import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from a2s.learner.run.config import Configuration


_NOT_OF_THE_RUN = (
    "listen", "tls", "password_file", "insecure", "metrics_port", "metrics_host", "fast_envs",
    "replay_from", "replay_journal", "connect", "episodes", "mode", "weights",
)  # fmt: skip


@taking(RUN)
def learner(
    context: typer.Context,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
    config: options.Config = None,
    settings: options.Set = None,
    print_config: options.PrintConfig = False,
    listen: options.Listen = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    insecure: options.Insecure = False,
    metrics_port: options.MetricsPort = None,
    metrics_host: options.MetricsHost = options.LOOPBACK,
    replay_from: options.ReplayFrom = None,
    replay_journal: options.ReplayJournal = None,
    connect: options.ReplayConnect = DEFAULT_ENDPOINT,
    again: options.Again = None,
    json_: options.Json = False,
) -> None:
    """Start the learner of a run; actors join it."""
    if number_and_count()[0] and not print_config:  # the first process has the rest
        require_learner()
        from a2s.commands.follow import follow_first

        raise typer.Exit(follow_first())
    given = options.named(context, RUN)
    if replay_from:
        given["variant"] = given["variant"] or "off-policy"
    if replay_journal:
        if resume or replay_from or config:
            raise UsageError(
                "--replay-journal: found with --resume, --replay-from or --config, expected alone; "
                "leave them out"
            )
        config = Path(replay_journal) / "config.toml"
        run_dir = _place_again(replay_journal, run_dir)
    configuration, path = _configure(context, given, config, run_dir)
    if replay_from and configuration.run.prior:
        raise UsageError("--prior: found with --replay-from, expected one of them; leave one out")
    place: dict[str, Any] = {
        "path": path,
        "resume": resume,
        "metrics_host": metrics_host,
        "metrics_port": metrics_port,
        "as_json": json_,
        "again": again or again_by(context, path),
    }
    security = Security(tls, password_file, insecure)
    if replay_from is not None:
        from a2s.commands.learn_from import learn_from
        from a2s.commands.learner import Place

        code = learn_from(
            configuration, Place(**place), replay_from, env=given["env"], connect=connect,
            security=security,
        )  # fmt: skip
        raise typer.Exit(code)
    from a2s.actors.description import Describing

    config_of_env = configuration.run.env_config()
    with closing(Describing(config_of_env, pass_on)) as describing:  # while torch is imported
        from a2s.commands.learner import Place, learn
        from a2s.commands.repeat import repeat

        if replay_journal:
            code = repeat(configuration, Place(**place), describing, Path(replay_journal))
        else:
            code = learn(configuration, Place(**place), describing, listen, security)
    raise typer.Exit(code)


@taking(RUN)
def train(
    context: typer.Context,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
    config: options.Config = None,
    settings: options.Set = None,
    print_config: options.PrintConfig = False,
    listen: options.ListenAnywhere = None,
    tls: options.Tls = None,
    password_file: options.PasswordFile = None,
    insecure: options.Insecure = False,
    metrics_port: options.MetricsPort = None,
    metrics_host: options.MetricsHost = options.LOOPBACK,
    fast_envs: options.FastEnvs = True,
    episodes: options.Episodes = 10,
    mode: options.Mode = "mean",
    weights: options.WhichWeights = "latest",
    json_: options.Json = False,
) -> None:
    """Train on this machine: a learner and its actors, then an evaluation and a curve."""
    given = options.named(context, RUN)
    from a2s.commands.train import actors_for
    from a2s.commands.train import train as train_here

    defaults = {"n": 2}
    if config is None and given["n"] is None and given["envs"] is None:
        defaults = actors_for(cores_here())
    configuration, path = _configure(context, given, config, run_dir, defaults=defaults)

    how = {"episodes": episodes, "mode": mode, "weights": weights, "seed": configuration.run.seed}
    raise typer.Exit(
        train_here(
            configuration,
            path,
            listen=listen,
            security=Security(tls, password_file, insecure),
            metrics_port=metrics_port,
            metrics_host=metrics_host,
            fast_envs=fast_envs,
            resume=resume,
            as_json=json_,
            again=again_by(context, path),
            evaluation=how,
        )
    )


def again_by(context: typer.Context, path: Path) -> str:
    """Write the command that goes on with a run: its file knows all but what is not of the run."""
    there = [name for name in _NOT_OF_THE_RUN if name in context.params]
    typed = options.given(context, there).typed
    words = ["a2s", str(context.info_name), "--resume", "--run-dir", str(path)]
    return shlex.join([*words, *options.words(context, typed)])


def _place_again(journal: str, run_dir: Path | None) -> Path:
    """Where a run is learned again: in an empty directory, beside it where none is named."""
    source = Path(journal)
    if source.name in ("", ".."):  # it is named as . or ..
        source = source.resolve()
    path = run_dir or Path(f"{source}-again")
    if path.is_dir() and any(path.iterdir()):
        raise UsageError(
            f"--replay-journal: {path} is not empty; delete it, or name another with --run-dir"
        )
    return path


def require_learner() -> None:
    """Refuse a command of the learner where only the actor is installed."""
    needed = ("torch", "onnx", "safetensors", "matplotlib")
    missing = [module for module in needed if importlib.util.find_spec(module) is None]
    if missing:
        raise UsageError(
            f"this command needs {', '.join(missing)}; install them: pip install 'a2s[learner]'"
        )


def _configure(
    context: typer.Context,
    given: dict[str, Any],
    config: Path | None,
    run_dir: Path | None,
    **more: Any,
) -> tuple["Configuration", Path]:
    """Make the configuration of a run, and choose its directory; ``--print-config`` ends here."""
    require_learner()
    from a2s.commands.configure import ROOT, configure, unfinished
    from a2s.learner.run.choice import made

    settings, resume = context.params["settings"], context.params["resume"]
    typed, variables = options.given(context, ("settings", *RUN))
    more["yielding"] = variables if "settings" in typed else ()
    configuration, path = configure(given, settings, config, run_dir, resume=resume, **more)
    if given["init_from"]:
        from a2s.learner.initial import configuration_of

        if resume:
            raise UsageError("--init-from: found with --resume, expected one: a run begins once")
        configuration_of(Path(given["init_from"]), configuration.run.variant)
    if configuration.run.tensorboard and importlib.util.find_spec("tensorboardX") is None:
        raise UsageError("--tensorboard needs tensorboardX; pip install 'a2s[tensorboard]'")
    if context.params["print_config"]:
        typer.echo(configuration.explain())
        raise typer.Exit
    if not resume and run_dir is None and (other := unfinished(configuration.run.run)) is not None:
        typer.echo(f"{other} has not ended; --resume goes on with it", err=True)
    if not resume and run_dir is None:
        path = context.with_resource(made(ROOT, configuration.run.run)).absolute()
    return configuration, path


@taking(ENVIRONMENT, ALGORITHM)
def tune(
    context: typer.Context,
    trials: Annotated[
        int, options.whole_number(None, "--trials", low=1, help="Trials in all, resumed ones too.")
    ] = 30,
    parallel: Annotated[
        int, options.whole_number(None, "--parallel", low=1, help="Trials at once.")
    ] = 1,
    space: Annotated[
        list[str] | None,
        options.option(
            None,
            "--space",
            metavar="KEY=RANGE",
            show_default="nine of the usual ones, off-policy six",
            help="LOW..HIGH, LOW..HIGH:log or VALUE,VALUE of a hyperparameter; may be repeated.",
        ),
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Directory of the search.")] = Path(
        "tune"
    ),
    settings: options.Set = None,
    json_: options.Json = False,
) -> None:
    """Search for hyperparameters with Optuna; the best are a file for --config."""
    require_learner()
    from a2s.commands.process import stop_on_signals
    from a2s.commands.tune import Search, default_space, line, parse_range
    from a2s.commands.tune import tune as search_for

    given = options.named(context, [*ENVIRONMENT, *ALGORITHM])
    ranges = [parse_range(text) for text in space or default_space(given["variant"], given["algo"])]
    words = options.words(context, given)
    search = Search(output.absolute(), words, given, settings or [], ranges)
    with stop_on_signals() as stop:
        found = search_for(
            search, trials=trials, parallel=parallel, seed=given["seed"] or 0, stop=stop
        )
    if found:
        typer.echo(json.dumps(found) if json_ else line(found))
    raise typer.Exit(stop.exit_code)
