"""The options that commands share: one definition each, with a variable of the environment.

An option that is not given is ``None``; then the variable, the file and the default follow in this
order. Parameters of commands are named as the configuration names them, so that `named` can read
them from the context of a command.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from a2s.learner.numerals import whole
from a2s.protocol.errors import UsageError

_FIRST = "To begin with"
_RUN = "The run"
_ENVIRONMENT = "The environment"
_ALGORITHM = "The algorithm"
_PLACE = "Where"
_REPLAY = "Another run's replay"
LOOPBACK = "127.0.0.1"
VARIABLES = set[str]()  # of all options
_MAX_SHOWN = 100_000  # a range that ends beyond says nothing to a reader


def named(context: typer.Context, names: Iterable[str]) -> dict[str, Any]:
    """Read parameters of a command: ``None`` where not given, tuples where repeatable."""
    values = {name: context.params[name] for name in names}
    return {n: tuple(v) or None if isinstance(v, list | tuple) else v for n, v in values.items()}


class Given(NamedTuple):
    """Parameters of a command: those of its command line, and those of variables besides."""

    typed: dict[str, Any]
    variables: dict[str, Any]


def given(context: typer.Context, names: Iterable[str]) -> Given:
    """Read parameters of a command as `named` does, by where they come from."""
    values = {name: v for name, v in named(context, names).items() if v is not None}
    is_typed = {name: _source(context, name) == "COMMANDLINE" for name in values}
    return Given(
        {name: v for name, v in values.items() if is_typed[name]},
        {name: v for name, v in values.items() if not is_typed[name]},
    )


def words(context: typer.Context, given: dict[str, Any]) -> list[str]:
    """Write options from `named` back as words of a command line."""
    options = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    values = {n: v if isinstance(v, tuple) else (v,) for n, v in given.items() if v is not None}
    return [
        word
        for n, many in values.items()
        for v in many
        for word in ([options[n]] if v is True else [options[n], str(v)])
    ]


def option(panel: str | None, *names: str, **settings: Any) -> Any:
    """Make an option in a panel of the help; ``--total-steps`` has the variable A2S_TOTAL_STEPS.

    The variable is not shown: all follow this one rule, which the program's help says.
    """
    common = {"envvar": _variable(names[0]), "show_envvar": False, "rich_help_panel": panel}
    settings = {**common, **settings}
    if variable := settings["envvar"]:
        VARIABLES.add(variable)
    return typer.Option(*names, **settings)


def whole_number(
    panel: str | None, *names: str, low: int | None = None, high: int | None = None, **settings: Any
) -> Any:
    """Make an option that takes a whole number within a closed range, also written as ``1e6``."""
    variable = settings.get("envvar", _variable(names[0]))
    subject = f"{names[0]} or {variable}" if variable else names[0]

    def parse(given: str | int) -> int:
        try:
            number = whole(given)
        except ValueError:
            raise UsageError(
                f"{subject}: found {given!r}, expected a whole number such as 1000 or 1e6"
            ) from None
        if (low is not None and number < low) or (high is not None and number > high):
            span = f"at least {low}" if high is None else f"{low} to {high}"
            raise UsageError(f"{subject}: found {given}, expected {span}")
        return number

    is_shown = low is not None and high is not None and high < _MAX_SHOWN
    metavar = f"{low}..{high}" if is_shown else "N"
    return option(panel, *names, **{"parser": parse, "metavar": metavar, **settings})


def _source(context: typer.Context, name: str) -> str:
    source = context.get_parameter_source(name)
    return "" if source is None else source.name


def _absolute(place: str) -> str:
    return str(Path(place).absolute())


def _variable(name: str) -> str:
    return name.partition("/")[0].replace("--", "A2S_").replace("-", "_").upper()


# A table: the name, range and default of each option, then its help.
# fmt: off

Env = Annotated[str | None, option(
    _FIRST, "--env", metavar="ENV", show_default="the run's, or Hopper-v5",
    help="Gymnasium id, module:Id-v0, module:Class, or ./FILE.py:Id-v0.",
)]
TotalSteps = Annotated[int | None, whole_number(
    _FIRST, "--total-steps", low=1, show_default="1000000",
    help="Environment steps at which the run ends, with a whole batch; for example 1e6.",
)]
Seed = Annotated[int | None, whole_number(
    _FIRST, "--seed", low=0, high=2**63 - 1, show_default="0", help="Seed of everything.",
)]
Run = Annotated[str | None, option(
    _RUN, "--run", metavar="NAME", show_default="default",
    help="Name of the run: actors join it by this name.",
)]
RunDir = Annotated[Path | None, option(
    _FIRST, "--run-dir", metavar="DIR",
    show_default="runs/RUN, or the first free of runs/RUN-2, ...",
    help="Directory of the run.",
)]
Resume = Annotated[bool, option(
    _FIRST, "--resume", help="Go on from the newest checkpoint of the run.",
)]
Config = Annotated[Path | None, option(
    _RUN, "--config", metavar="FILE",
    help="TOML file with the tables run and hyper, as every run directory has one.",
)]
InitFrom = Annotated[str | None, option(
    _RUN, "--init-from", metavar="DIR", parser=_absolute,
    help="Begin with the weights and normalisers of this run, as far as they fit.",
)]
Tensorboard = Annotated[bool | None, option(
    _RUN, "--tensorboard/--no-tensorboard", show_default="off",
    help="Write event files for TensorBoard, with the names of Stable-Baselines3, as well.",
)]
KeepPolicyEvery = Annotated[int | None, whole_number(
    _RUN, "--keep-policy-every", low=0, show_default="0",
    help="Keep a copy of the policy in policies/ after every N updates (off-policy gradient steps)."
    " 0: never.",
)]
EvaluateEvery = Annotated[int | None, whole_number(
    _RUN, "--evaluate-every", low=0, show_default="0",
    help="Steps between evaluations while training; 0: none.",
)]
EvaluationEpisodes = Annotated[int | None, whole_number(
    _RUN, "--evaluation-episodes", low=1, high=1000, show_default="10",
    help="Episodes of an evaluation while training.",
)]
StopAtReturn = Annotated[float | None, option(
    _RUN, "--stop-at-return", metavar="R", show_default="never",
    help="End the run once an evaluation while training has had this mean return.",
)]
Episodes = Annotated[int, whole_number(
    _RUN, "--episodes", low=1, help="Episodes to play.",
)]
WhichWeights = Annotated[str, option(
    _RUN, "--weights", metavar="latest|best",
    help="Which policy of a run: latest, or best (by evaluations, else by training returns).",
)]

EnvKwargs = Annotated[list[str] | None, option(
    _ENVIRONMENT, "--env-kwargs", metavar="KEY=VALUE",
    help="KEY=VALUE of its constructor, VALUE in JSON or a text; may be repeated.",
)]
Wrapper = Annotated[list[str] | None, option(
    _ENVIRONMENT, "--wrapper", metavar="CLASS",
    help="module:Class or module:Class={JSON} around it; may be repeated, innermost first.",
)]
ActionRepeat = Annotated[int | None, whole_number(
    _ENVIRONMENT, "--action-repeat", low=1, high=1000, show_default="the run's, or 1",
    help="Environment steps for each action; their rewards are added up.",
)]
FrameStack = Annotated[int | None, whole_number(
    _ENVIRONMENT, "--frame-stack", low=1, high=1000, show_default="the run's, or 1",
    help="Latest observations that the policy sees at once.",
)]
MaxEpisodeSteps = Annotated[int | None, whole_number(
    _ENVIRONMENT, "--max-episode-steps", low=1, high=2 ** 31 - 1, show_default="its own limit",
    help="Environment steps after which an episode is truncated.",
)]
EnvTimeout = Annotated[float | None, option(
    _ENVIRONMENT, "--env-timeout", metavar="SECONDS", min=0.001, show_default="the run's, or 120",
    help="Seconds in which a call into it must return; else its process is replaced.",
)]
InfoMetric = Annotated[list[str] | None, option(
    _ENVIRONMENT, "--info-metric", metavar="KEY",
    help="Key of info whose number is kept with each episode, besides is_success; repeatable.",
)]

Variant = Annotated[str | None, option(
    _ALGORITHM, "--variant", metavar="on-policy|off-policy", show_default="on-policy",
    help="on-policy (algorithm 1 of the paper) or off-policy (algorithm 2).",
)]
Algo = Annotated[str | None, option(
    _ALGORITHM, "--algo", metavar="a2s|a2c", show_default="a2s",
    help="a2s, or a2c: one suggestion and no Q.",
)]
Preset = Annotated[str | None, option(
    _ALGORITHM, "--preset", metavar="NAME", show_default="modern",
    help="Hyperparameters: modern, authors or paper; off-policy modern, sac or paper.",
)]
Suggestions = Annotated[int | None, whole_number(
    _ALGORITHM, "--suggestions", show_default="from the preset",
    help="K, the actions among which Q picks.",
)]
Recovery = Annotated[bool | None, option(
    _ALGORITHM, "--recovery/--no-recovery", show_default="on for a2s, off for a2c",
    help="Go back to the best networks when returns fall (equation 5); on-policy only.",
)]
Set = Annotated[list[str] | None, option(
    _ALGORITHM, "--set", metavar="KEY=VALUE",
    help="KEY=VALUE of any hyperparameter (--print-config shows them); may be repeated.",
)]
Lockstep = Annotated[bool | None, option(
    _ALGORITHM, "--lockstep/--async", show_default="lockstep, off-policy async",
    help="Use each version for one batch, reproducibly; or never let actors wait.",
)]
PrintConfig = Annotated[bool, option(
    _ALGORITHM, "--print-config",
    help="Show every setting, hyperparameters with their sources, and do nothing else.",
)]
Mode = Annotated[str, option(
    _ALGORITHM, "--mode", metavar="mean|best-of-k|behaviour",
    help="How to act: mean, best-of-k or behaviour.",
)]

N = Annotated[int | None, whole_number(
    _PLACE, "--n", "-n", low=1, show_default="1; a2s train by the cores, up to 8",
    help="Actor processes; a learner waits for so many before it begins.",
)]
Envs = Annotated[int | None, whole_number(
    _PLACE, "--envs", low=1, high=4096, show_default="the learner's, 8; a2s train 16 in all",
    help="Environments in each actor process.",
)]
Threads = Annotated[int | None, whole_number(
    _PLACE, "--threads", low=1, show_default="1", help="Threads of torch in the learner.",
)]
Device = Annotated[str | None, option(
    _PLACE, "--device", metavar="cpu|cuda", show_default="cpu",
    help="Where the learner's networks are, off-policy: cpu or cuda.",
)]
Tls = Annotated[str | None, option(
    _PLACE, "--tls", metavar="DIR",
    help="Encrypt, and show a certificate: of this folder, or of the one in it for this command. "
    "`a2s certs` makes them.",
)]
PasswordFile = Annotated[str | None, option(
    _PLACE, "--password-file", metavar="FILE",
    help="Instead of --tls: file with a line USER:PASSWORD; the learner's has one for each user.",
)]
Insecure = Annotated[bool, option(
    _PLACE, "--insecure",
    help="Listen where others can reach it, with neither --tls nor --password-file.",
)]
Listen = Annotated[str | None, option(
    _PLACE, "--listen", metavar="ENDPOINT", show_default="tcp/127.0.0.1:7447",
    help="Endpoint on which the learner listens.",
)]
ListenAnywhere = Annotated[str | None, option(
    _PLACE, "--listen", metavar="ENDPOINT", show_default="a free port of this machine",
    help="Endpoint on which the learner listens, for more actors than those here.",
)]
Connect = Annotated[str, option(
    _PLACE, "--connect", metavar="ENDPOINT", help="Endpoint of the learner.",
)]
MaybeConnect = Annotated[str | None, option(
    _PLACE, "--connect", metavar="ENDPOINT", show_default="tcp/127.0.0.1:7447",
    help="Endpoint of the learner.",
)]
ReplayFrom = Annotated[str | None, option(
    _REPLAY, "--replay-from", metavar="RUN",
    help="Learn off-policy from this run's replay: a directory, or a run at --connect.",
)]
ReplayJournal = Annotated[str | None, option(
    _REPLAY, "--replay-journal", metavar="DIR",
    help="Learn again, without actors, what the run in this directory has in its journal.",
)]
Prior = Annotated[str | None, option(
    _REPLAY, "--prior", metavar="DIR", parser=_absolute,
    help="Learn off-policy from these transitions as well: of a2s replay import, or of a run.",
)]
PriorShare = Annotated[float | None, option(
    _REPLAY, "--prior-share", metavar="SHARE", show_default="0.5",
    help="Share of every batch that is drawn from --prior.",
)]
Evaluate = Annotated[bool, option(
    None, "--evaluate", help="Evaluate the newest weights instead of playing for the learner.",
)]
ReplayConnect = Annotated[str, option(
    _REPLAY, "--connect", metavar="ENDPOINT",
    help="With --replay-from: endpoint of the learner whose replay it is.",
)]
AllowEnv = Annotated[list[str] | None, option(
    None, "--allow-env", metavar="CODE",
    help="Code that the learner may have it run: a module or FILE.py, with :NAME for no more; may "
    "be repeated. What Gymnasium knows needs none.",
)]
FastEnvs = Annotated[bool, option(
    _PLACE, "--fast-envs/--no-fast-envs", show_default="on",
    help="Step Gymnasium's own MuJoCo environments without what a run does not read, to the same "
    "results; or with it.",
)]
OutboxSteps = Annotated[int, whole_number(
    None, "--outbox-steps", low=1, show_envvar=True,
    help="Steps that each process keeps at most while the learner is away.",
)]
SpoolSteps = Annotated[int | None, whole_number(  # the former name of the same
    None, "--spool-steps", low=1, hidden=True,
)]
MetricsPort = Annotated[int | None, whole_number(
    _PLACE, "--metrics-port", low=-1, high=65535, show_default="9464, a2s actor 9465",
    help="Port of /metrics: 0 takes any free one, -1 serves none.",
)]
MetricsHost = Annotated[str, option(
    _PLACE, "--metrics-host", help="Address on which /metrics is served.",
)]
Again = Annotated[str | None, option(  # from a2s train to its learner
    _PLACE, "--again", hidden=True, envvar=None, help="The command that goes on with the run.",
)]
Json = Annotated[bool, option(
    _PLACE, "--json", help="Print JSON as the last line of standard output.",
)]

# fmt: on
