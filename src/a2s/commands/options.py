"""The options that commands share: one definition each, with a variable of the environment.

An option that is not given is ``None``, so that a configuration file can have its say:
option, then variable, then file, then default.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from a2s.commands.whole_number import whole_number

_RUN = "The run"
_ALGORITHM = "The algorithm"
_PLACE = "Where"


def option(*names: str, env: str, help: str, panel: str, **more: Any) -> Any:  # noqa: A002
    """Make an option with a variable of the environment, in a panel of the help."""
    more = {"show_envvar": False, **more}  # they all follow one rule, which the program's help says
    return typer.Option(*names, envvar=env, help=help, rich_help_panel=panel, **more)


def whole(*names: str, env: str, help: str, panel: str, **more: Any) -> Any:  # noqa: A002
    """Make one that takes a whole number."""
    more = {"show_envvar": False, **more}
    return whole_number(*names, env=env, help=help, rich_help_panel=panel, **more)


Env = Annotated[
    str | None,
    option(
        "--env",
        metavar="ENV",
        env="A2S_ENV",
        help="Gymnasium id, module:Id-v0, module:Class, or ./FILE.py:Id-v0.",
        panel=_RUN,
        show_default="Hopper-v5",
    ),
]
TotalSteps = Annotated[
    int | None,
    whole(
        "--total-steps",
        env="A2S_TOTAL_STEPS",
        help="Environment steps at which the run ends, for example 1e6.",
        panel=_RUN,
        least=1,
        show_default="1000000",
    ),
]
Seed = Annotated[
    int | None,
    whole(
        "--seed",
        env="A2S_SEED",
        help="Seed of everything.",
        panel=_RUN,
        least=0,
        most=2**63 - 1,
        show_default="0",
    ),
]
Run = Annotated[
    str | None,
    option(
        "--run",
        metavar="NAME",
        env="A2S_RUN",
        help="Name of the run: actors join it by this name.",
        panel=_RUN,
        show_default="default",
    ),
]
RunDir = Annotated[
    Path | None,
    option(
        "--run-dir",
        metavar="DIR",
        env="A2S_RUN_DIR",
        help="Directory of the run.",
        panel=_RUN,
        show_default="runs/RUN, or the first free of runs/RUN-2, ...",
    ),
]
Resume = Annotated[
    bool,
    option(
        "--resume",
        env="A2S_RESUME",
        help="Go on from the newest checkpoint of the run.",
        panel=_RUN,
    ),
]
Config = Annotated[
    Path | None,
    option(
        "--config",
        metavar="FILE",
        env="A2S_CONFIG",
        help="TOML file with the tables run and hyper, as every run directory has one.",
        panel=_RUN,
    ),
]
Variant = Annotated[
    str | None,
    option(
        "--variant",
        metavar="on-policy|off-policy",
        env="A2S_VARIANT",
        help="on-policy (algorithm 1 of the paper) or off-policy (algorithm 2).",
        panel=_ALGORITHM,
        show_default="on-policy",
    ),
]
Algo = Annotated[
    str | None,
    option(
        "--algo",
        metavar="a2s|a2c",
        env="A2S_ALGO",
        help="a2s, or a2c: one suggestion and no Q.",
        panel=_ALGORITHM,
        show_default="a2s",
    ),
]
Preset = Annotated[
    str | None,
    option(
        "--preset",
        metavar="NAME",
        env="A2S_PRESET",
        help="Hyperparameters: modern, authors or paper; off-policy modern, sac or paper.",
        panel=_ALGORITHM,
        show_default="modern",
    ),
]
Suggestions = Annotated[
    int | None,
    whole(
        "--suggestions",
        env="A2S_SUGGESTIONS",
        help="K, the actions among which Q picks.",
        panel=_ALGORITHM,
        show_default="from the preset",
    ),
]
Recovery = Annotated[
    bool | None,
    option(
        "--recovery/--no-recovery",
        env="A2S_RECOVERY",
        help="Go back to the best networks when returns fall (equation 5); on-policy only.",
        panel=_ALGORITHM,
        show_default="on for a2s, off for a2c",
    ),
]
Set = Annotated[
    list[str] | None,
    option(
        "--set",
        env="A2S_SET",
        help="KEY=VALUE of any hyperparameter (--print-config shows them); may be repeated.",
        panel=_ALGORITHM,
        metavar="KEY=VALUE",
    ),
]
Lockstep = Annotated[
    bool | None,
    option(
        "--lockstep/--async",
        env="A2S_LOCKSTEP",
        help="Use each version for one batch, reproducibly; or never let actors wait.",
        panel=_ALGORITHM,
        show_default="lockstep",
    ),
]
PrintConfig = Annotated[
    bool,
    option(
        "--print-config",
        env="A2S_PRINT_CONFIG",
        help="Show every setting with its source, and do nothing else.",
        panel=_ALGORITHM,
    ),
]
N = Annotated[
    int | None,
    whole("--n", "-n", env="A2S_N", help="Actor processes.", panel=_PLACE, least=1),
]
Envs = Annotated[
    int | None,
    whole(
        "--envs",
        env="A2S_ENVS",
        help="Environments in each actor process.",
        panel=_PLACE,
        least=1,
        most=4096,
        show_default="8",
    ),
]
KeepPolicyEvery = Annotated[
    int | None,
    whole(
        "--keep-policy-every",
        env="A2S_KEEP_POLICY_EVERY",
        help="Keep the policy after every so many updates, in policies/; 0 keeps none.",
        panel=_RUN,
        least=0,
        show_default="0",
    ),
]
Threads = Annotated[
    int | None,
    whole(
        "--threads",
        env="A2S_THREADS",
        help="Threads of torch in the learner.",
        panel=_PLACE,
        least=1,
        show_default="1",
    ),
]
Device = Annotated[
    str | None,
    option(
        "--device",
        metavar="cpu|cuda",
        env="A2S_DEVICE",
        help="Where the learner's networks are, off-policy: cpu or cuda.",
        panel=_PLACE,
        show_default="cpu",
    ),
]
Listen = Annotated[
    str | None,
    option(
        "--listen",
        env="A2S_LISTEN",
        help="Endpoint on which the learner listens.",
        panel=_PLACE,
        metavar="ENDPOINT",
        show_default="tcp/127.0.0.1:7447",
    ),
]
Connect = Annotated[
    str,
    option(
        "--connect",
        env="A2S_CONNECT",
        help="Endpoint of the learner.",
        panel=_PLACE,
        metavar="ENDPOINT",
    ),
]
MetricsPort = Annotated[
    int | None,
    whole(
        "--metrics-port",
        env="A2S_METRICS_PORT",
        help="Port of /metrics: 0 takes any free one, -1 serves none.",
        panel=_PLACE,
        least=-1,
        most=65535,
    ),
]
MetricsHost = Annotated[
    str,
    option(
        "--metrics-host",
        env="A2S_METRICS_HOST",
        help="Address on which /metrics is served.",
        panel=_PLACE,
    ),
]
Json = Annotated[
    bool,
    option(
        "--json",
        env="A2S_JSON",
        help="Print one JSON object as the last line of standard output.",
        panel=_PLACE,
    ),
]
Episodes = Annotated[
    int,
    whole("--episodes", env="A2S_EPISODES", help="Episodes to play.", panel=_RUN, least=1),
]
Mode = Annotated[
    str,
    option(
        "--mode",
        metavar="mean|best-of-k|behaviour",
        env="A2S_MODE",
        help="How to act: mean, best-of-k or behaviour.",
        panel=_ALGORITHM,
    ),
]
WhichWeights = Annotated[
    str,
    option(
        "--weights",
        metavar="latest|best",
        env="A2S_WEIGHTS",
        help="Which policy of a run: latest, or best (by training returns).",
        panel=_RUN,
    ),
]
