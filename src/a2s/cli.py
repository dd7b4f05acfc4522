"""The command line: parses options and calls; every command imports what it needs when it runs."""

import importlib.util
import json
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from a2s import __version__
from a2s.commands import env_options, options, replay_cli
from a2s.commands.serving import fill_standard_streams
from a2s.commands.stopping import end_on_signals
from a2s.commands.whole_number import whole_number
from a2s.learner.numerals import written
from a2s.protocol.errors import A2SError, UsageError
from a2s.protocol.keys import DEFAULT_ENDPOINT

EXIT_FAILED = 1
EXIT_USAGE = 2
_LOOPBACK = "127.0.0.1"

app = typer.Typer(
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Train continuous control with many actors and one learner: the policy suggests, Q picks."
    "\n\nEvery option can be given by a variable: --total-steps by A2S_TOTAL_STEPS.",
)
app.add_typer(replay_cli.app, name="replay")


def _show_version(value: bool) -> None:
    if value:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _about(
    _version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_show_version, is_eager=True, help="Show it."),
    ] = False,
) -> None:
    pass


@app.command()
def learner(
    env: options.Env = None,
    total_steps: options.TotalSteps = None,
    seed: options.Seed = None,
    run: options.Run = None,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
    config: options.Config = None,
    env_kwargs: env_options.EnvKwargs = None,
    wrapper: env_options.Wrapper = None,
    action_repeat: env_options.ActionRepeat = None,
    frame_stack: env_options.FrameStack = None,
    max_episode_steps: env_options.MaxEpisodeSteps = None,
    env_timeout: env_options.EnvTimeout = None,
    info_metric: env_options.InfoMetric = None,
    variant: options.Variant = None,
    algo: options.Algo = None,
    preset: options.Preset = None,
    suggestions: options.Suggestions = None,
    recovery: options.Recovery = None,
    settings: options.Set = None,
    lockstep: options.Lockstep = None,
    print_config: options.PrintConfig = False,
    n: options.N = None,
    envs: options.Envs = None,
    threads: options.Threads = None,
    device: options.Device = None,
    keep_policy_every: options.KeepPolicyEvery = None,
    listen: options.Listen = None,
    metrics_port: options.MetricsPort = None,
    metrics_host: options.MetricsHost = _LOOPBACK,
    replay_from: Annotated[
        str | None,
        typer.Option(
            envvar="A2S_REPLAY_FROM",
            metavar="RUN",
            help="Learn off-policy from this run's replay: a directory, or a run at --connect.",
        ),
    ] = None,
    connect: options.Connect = DEFAULT_ENDPOINT,
    json_: options.Json = False,
) -> None:
    """Start the learner of a run; actors join it."""
    _require_learner()
    from a2s.commands.configure import configure

    given = {
        "env": env, "total_steps": total_steps, "seed": seed, "run": run,
        "variant": variant or ("off-policy" if replay_from else None),
        "algo": algo, "preset": preset, "suggestions": suggestions, "recovery": recovery,
        "lockstep": lockstep,
        "n": n, "envs": envs, "threads": threads, "device": device,
        "keep_policy_every_updates": keep_policy_every,
        **env_options.environment(
            env_kwargs, wrapper, action_repeat, frame_stack, max_episode_steps, env_timeout,
            info_metric,
        ),
    }  # fmt: skip
    configuration, path = configure(given, settings, config, run_dir, resume=resume)
    if print_config:
        typer.echo(configuration.explain())
        return
    from a2s.commands.learner import learn, learn_from

    if replay_from is not None:
        raise typer.Exit(
            learn_from(
                configuration,
                path,
                replay_from,
                env=env,
                connect=connect,
                metrics_host=metrics_host,
                metrics_port=metrics_port,
                resume=resume,
                as_json=json_,
            )
        )
    raise typer.Exit(
        learn(
            configuration,
            path,
            listen=listen,
            metrics_host=metrics_host,
            metrics_port=metrics_port,
            resume=resume,
            as_json=json_,
        )
    )


@app.command()
def actor(
    n: options.N = None,
    envs: options.Envs = None,
    run: options.Run = None,
    connect: options.Connect = DEFAULT_ENDPOINT,
    outbox_steps: Annotated[
        int,
        whole_number(
            "--outbox-steps",
            env="A2S_OUTBOX_STEPS",
            least=1,
            help="Steps that each process keeps at most while the learner is away.",
        ),
    ] = 65_536,
    spool_steps: Annotated[  # as it was called before
        int | None, whole_number("--spool-steps", env="A2S_SPOOL_STEPS", least=1, hidden=True)
    ] = None,
    metrics_port: options.MetricsPort = None,
    metrics_host: options.MetricsHost = _LOOPBACK,
) -> None:
    """Start supervised actor processes that join a run; the learner tells them everything else."""
    from a2s.commands.actor import act

    raise typer.Exit(
        act(
            n=n or 1,
            envs=envs,
            run=run or "default",
            connect=connect,
            outbox_steps=spool_steps or outbox_steps,
            metrics_host=metrics_host,
            metrics_port=metrics_port,
        )
    )


@app.command()
def train(
    env: options.Env = None,
    total_steps: options.TotalSteps = None,
    seed: options.Seed = None,
    run: options.Run = None,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
    config: options.Config = None,
    env_kwargs: env_options.EnvKwargs = None,
    wrapper: env_options.Wrapper = None,
    action_repeat: env_options.ActionRepeat = None,
    frame_stack: env_options.FrameStack = None,
    max_episode_steps: env_options.MaxEpisodeSteps = None,
    env_timeout: env_options.EnvTimeout = None,
    info_metric: env_options.InfoMetric = None,
    variant: options.Variant = None,
    algo: options.Algo = None,
    preset: options.Preset = None,
    suggestions: options.Suggestions = None,
    recovery: options.Recovery = None,
    settings: options.Set = None,
    lockstep: options.Lockstep = None,
    print_config: options.PrintConfig = False,
    n: options.N = None,
    envs: options.Envs = None,
    threads: options.Threads = None,
    device: options.Device = None,
    keep_policy_every: options.KeepPolicyEvery = None,
    listen: options.Listen = None,
    metrics_port: options.MetricsPort = None,
    episodes: options.Episodes = 10,
    mode: options.Mode = "mean",
    weights: options.WhichWeights = "latest",
    json_: options.Json = False,
) -> None:
    """Train on this machine: a learner and its actors, then an evaluation and a curve."""
    _require_learner()
    from a2s.commands.configure import configure

    given = {
        "env": env, "total_steps": total_steps, "seed": seed, "run": run, "variant": variant,
        "algo": algo, "preset": preset, "suggestions": suggestions, "recovery": recovery,
        "lockstep": lockstep,
        "n": n, "envs": envs, "threads": threads, "device": device,
        "keep_policy_every_updates": keep_policy_every,
        **env_options.environment(
            env_kwargs, wrapper, action_repeat, frame_stack, max_episode_steps, env_timeout,
            info_metric,
        ),
    }  # fmt: skip
    configuration, path = configure(
        given, settings, config, run_dir, resume=resume, defaults={"n": 2}
    )
    if print_config:
        typer.echo(configuration.explain())
        return
    from a2s.commands.train import train as train_here

    raise typer.Exit(
        train_here(
            configuration,
            path,
            listen=listen,
            metrics_port=metrics_port,
            resume=resume,
            as_json=json_,
            evaluation={
                "episodes": episodes,
                "mode": mode,
                "weights": weights,
                "seed": configuration.run.seed,
            },
        )
    )


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="A run directory, or a policy file.")],
    env: options.Env = None,
    episodes: options.Episodes = 10,
    mode: options.Mode = "mean",
    weights: options.WhichWeights = "latest",
    seed: options.Seed = None,
    env_kwargs: env_options.EnvKwargs = None,
    wrapper: env_options.Wrapper = None,
    action_repeat: env_options.ActionRepeat = None,
    frame_stack: env_options.FrameStack = None,
    max_episode_steps: env_options.MaxEpisodeSteps = None,
    env_timeout: env_options.EnvTimeout = None,
    info_metric: env_options.InfoMetric = None,
    json_: options.Json = False,
) -> None:
    """Play fresh episodes with a trained policy."""
    from a2s.commands.evaluate import evaluate_run

    given = {
        "env": env,
        **env_options.environment(
            env_kwargs, wrapper, action_repeat, frame_stack, max_episode_steps, env_timeout,
            info_metric,
        ),
    }  # fmt: skip
    result = evaluate_run(run, given, episodes=episodes, mode=mode, weights=weights, seed=seed or 0)
    if json_:
        typer.echo(json.dumps(result))
    else:
        mean, std = written(result["mean"]), written(result["std"])
        low, high = written(min(result["returns"])), written(max(result["returns"]))
        typer.echo(
            f"{result['env']}: {mean} +- {std} over {episodes} episodes ({mode}); "
            f"from {low} to {high}"
        )


@app.command()
def check(
    environment: Annotated[
        str | None, typer.Argument(help="As --env of a2s train.", metavar="ENV")
    ] = None,
    env: options.Env = None,
    env_kwargs: env_options.EnvKwargs = None,
    wrapper: env_options.Wrapper = None,
    action_repeat: env_options.ActionRepeat = None,
    frame_stack: env_options.FrameStack = None,
    max_episode_steps: env_options.MaxEpisodeSteps = None,
    env_timeout: env_options.EnvTimeout = None,
    info_metric: env_options.InfoMetric = None,
    json_: options.Json = False,
) -> None:
    """Try an environment: whether it can be trained on, what it is, and how fast."""
    from a2s.commands.check import check_environment, page
    from a2s.commands.configure import environment_of

    if (environment is None) == (env is None):
        raise UsageError("a2s check: name one environment, for example a2s check Hopper-v5")
    given = {
        "env": environment or env,
        **env_options.environment(
            env_kwargs, wrapper, action_repeat, frame_stack, max_episode_steps, env_timeout,
            info_metric,
        ),
    }  # fmt: skip
    found = check_environment(environment_of(given))
    command = shlex.join(["a2s", "train", *env_options.words(given)])
    typer.echo(json.dumps(found) if json_ else page(found, command))


@app.command()
def plot(
    runs: Annotated[list[Path], typer.Argument(help="Run directories.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", envvar="A2S_OUTPUT", help="Picture to write.")
    ] = Path("curves.png"),
) -> None:
    """Draw learning curves: every seed light, their mean with a moving average of 3."""
    _require_learner()
    from a2s.commands.plot import plot as draw

    for reason in draw(runs, output):
        sys.stderr.write(f"a2s: left out: {reason}\n")
    typer.echo(f"{output}")


@app.command()
def bench(
    suite: Annotated[str, typer.Argument(help="actor, learner, wire or replay.")],
    rounds: Annotated[int, whole_number("--rounds", least=1, help="Turns of every contender.")] = 9,
    seconds: Annotated[float, typer.Option(min=0.0, help="Of one turn, at least.")] = 0.2,
    json_: options.Json = False,
) -> None:
    """Measure this machine: rates beside others' in the same run, medians over the rounds."""
    _require_learner()
    from a2s.commands import bench as benchmarks

    rows = benchmarks.bench(suite, rounds, seconds)
    if json_:
        typer.echo(json.dumps(rows))
        return
    for row in rows:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:8.2f} x the fastest other"
        typer.echo(f"{row['name']:<44}{row['value']:>14,.6g} {row['unit']:<14}{ratio}")


def _require_learner() -> None:
    missing = [m for m in ("torch", "onnx", "safetensors", "matplotlib") if not _installed(m)]
    if missing:
        raise UsageError(
            f"this command needs {', '.join(missing)}; install them: pip install 'a2s[learner]'"
        )


def _installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def main() -> None:
    """Run the command line; what is expected to go wrong is one line on standard error."""
    end_on_signals()
    fill_standard_streams()
    try:
        app()
    except A2SError as error:
        sys.stderr.write(f"a2s: {error}\n")
        sys.exit(EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED)
    except PermissionError as error:
        sys.stderr.write(
            f"a2s: {error.filename}: {error.strerror}; run as who may read and write it\n"
        )
        sys.exit(EXIT_FAILED)


if __name__ == "__main__":
    main()
