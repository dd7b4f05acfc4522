"""The options that commands share: one definition each, with a variable of the environment.

An option that is not given is ``None``, so that a configuration file can have its say:
option, then variable, then file, then default.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

_RUN = "The run"
_ALGORITHM = "The algorithm"
_PLACE = "Where"


def _option(*names: str, env: str, help: str, panel: str, **more: Any) -> Any:  # noqa: A002
    return typer.Option(*names, envvar=env, help=help, rich_help_panel=panel, **more)


Env = Annotated[
    str | None,
    _option(
        "--env",
        env="A2S_ENV",
        help="Gymnasium id, or module:Id-v0.",
        panel=_RUN,
        show_default="Hopper-v5",
    ),
]
TotalSteps = Annotated[
    int | None,
    _option(
        "--total-steps",
        env="A2S_TOTAL_STEPS",
        help="Environment steps at which the run ends.",
        panel=_RUN,
        min=1,
        show_default="1000000",
    ),
]
Seed = Annotated[
    int | None,
    _option(
        "--seed",
        env="A2S_SEED",
        help="Seed of everything.",
        panel=_RUN,
        min=0,
        max=2**63 - 1,
        show_default="0",
    ),
]
Run = Annotated[
    str | None,
    _option(
        "--run",
        env="A2S_RUN",
        help="Name of the run: actors join it by this name.",
        panel=_RUN,
        show_default="default",
    ),
]
RunDir = Annotated[
    Path | None,
    _option(
        "--run-dir",
        env="A2S_RUN_DIR",
        help="Directory of the run.",
        panel=_RUN,
        show_default="runs/RUN, or the first free of runs/RUN-2, ...",
    ),
]
Resume = Annotated[
    bool,
    _option(
        "--resume",
        env="A2S_RESUME",
        help="Go on from the newest checkpoint of the run.",
        panel=_RUN,
    ),
]
Config = Annotated[
    Path | None,
    _option(
        "--config",
        env="A2S_CONFIG",
        help="TOML file with the tables run and hyper, as every run directory has one.",
        panel=_RUN,
    ),
]
Variant = Annotated[
    str | None,
    _option(
        "--variant",
        env="A2S_VARIANT",
        help="on-policy (algorithm 1 of the paper) or off-policy (algorithm 2).",
        panel=_ALGORITHM,
        show_default="on-policy",
    ),
]
Algo = Annotated[
    str | None,
    _option(
        "--algo",
        env="A2S_ALGO",
        help="a2s, or a2c: one suggestion and no Q.",
        panel=_ALGORITHM,
        show_default="a2s",
    ),
]
Preset = Annotated[
    str | None,
    _option(
        "--preset",
        env="A2S_PRESET",
        help="Hyperparameters: modern, authors or paper; off-policy modern, sac or paper.",
        panel=_ALGORITHM,
        show_default="modern",
    ),
]
Suggestions = Annotated[
    int | None,
    _option(
        "--suggestions",
        env="A2S_SUGGESTIONS",
        help="K, the actions among which Q picks.",
        panel=_ALGORITHM,
        show_default="from the preset",
    ),
]
Recovery = Annotated[
    bool | None,
    _option(
        "--recovery/--no-recovery",
        env="A2S_RECOVERY",
        help="Go back to the best networks when returns fall (equation 5); on-policy only.",
        panel=_ALGORITHM,
        show_default="on for a2s, off for a2c",
    ),
]
Set = Annotated[
    list[str] | None,
    _option(
        "--set",
        env="A2S_SET",
        help="KEY=VALUE of any hyperparameter (--print-config shows them); may be repeated.",
        panel=_ALGORITHM,
        metavar="KEY=VALUE",
    ),
]
Lockstep = Annotated[
    bool | None,
    _option(
        "--lockstep/--async",
        env="A2S_LOCKSTEP",
        help="Use each version for one batch, reproducibly; or never let actors wait.",
        panel=_ALGORITHM,
        show_default="lockstep",
    ),
]
PrintConfig = Annotated[
    bool,
    _option(
        "--print-config",
        env="A2S_PRINT_CONFIG",
        help="Show every setting with its source, and do nothing else.",
        panel=_ALGORITHM,
    ),
]
N = Annotated[
    int | None,
    _option("--n", "-n", env="A2S_N", help="Actor processes.", panel=_PLACE, min=1),
]
Envs = Annotated[
    int | None,
    _option(
        "--envs",
        env="A2S_ENVS",
        help="Environments in each actor process.",
        panel=_PLACE,
        min=1,
        max=4096,
        show_default="8",
    ),
]
KeepPolicyEvery = Annotated[
    int | None,
    _option(
        "--keep-policy-every",
        env="A2S_KEEP_POLICY_EVERY",
        help="Keep the policy after every so many updates, in policies/; 0 keeps none.",
        panel=_RUN,
        min=0,
        show_default="0",
    ),
]
Threads = Annotated[
    int | None,
    _option(
        "--threads",
        env="A2S_THREADS",
        help="Threads of torch in the learner.",
        panel=_PLACE,
        min=1,
        show_default="1",
    ),
]
Device = Annotated[
    str | None,
    _option(
        "--device",
        env="A2S_DEVICE",
        help="Where the learner's networks are, off-policy: cpu or cuda.",
        panel=_PLACE,
        show_default="cpu",
    ),
]
Listen = Annotated[
    str | None,
    _option(
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
    _option(
        "--connect",
        env="A2S_CONNECT",
        help="Endpoint of the learner.",
        panel=_PLACE,
        metavar="ENDPOINT",
    ),
]
MetricsPort = Annotated[
    int | None,
    _option(
        "--metrics-port",
        env="A2S_METRICS_PORT",
        help="Port of /metrics: 0 takes any free one, -1 serves none.",
        panel=_PLACE,
        min=-1,
        max=65535,
    ),
]
MetricsHost = Annotated[
    str,
    _option(
        "--metrics-host",
        env="A2S_METRICS_HOST",
        help="Address on which /metrics is served.",
        panel=_PLACE,
    ),
]
Json = Annotated[
    bool,
    _option(
        "--json",
        env="A2S_JSON",
        help="Print one JSON object as the last line of standard output.",
        panel=_PLACE,
    ),
]
Episodes = Annotated[
    int,
    _option("--episodes", env="A2S_EPISODES", help="Episodes to play.", panel=_RUN, min=1),
]
Mode = Annotated[
    str,
    _option(
        "--mode",
        env="A2S_MODE",
        help="How to act: mean, best-of-k or behaviour.",
        panel=_ALGORITHM,
    ),
]
WhichWeights = Annotated[
    str,
    _option(
        "--weights",
        env="A2S_WEIGHTS",
        help="Which policy of a run: latest, or best (by training returns).",
        panel=_RUN,
    ),
]
