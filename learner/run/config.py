"""What a run is: every setting, from the command line or a file, checked, and written down.

A configuration is two tables of TOML, as every run directory keeps it::

    [run]     environment, algorithm, lengths, seed: the options of the command line
    [hyper]   every hyperparameter, as `a2s learner --print-config` shows them
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tomlkit

from a2s.learner.off_policy import presets as off_policy_presets
from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.on_policy import presets
from a2s.learner.on_policy.hyperparameters import OnPolicyHyper
from a2s.learner.on_policy.presets import Choice
from a2s.learner.run.numerals import whole
from a2s.learner.run.other_names import OFF_POLICY, ON_POLICY, RUN, meant, without_removed
from a2s.protocol.env_config import TIMEOUT_S, EnvConfig, kwargs_of, wrapper_of
from a2s.protocol.errors import MalformedMessageError, UsageError, nearest
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Clock

Variant = Literal["on-policy", "off-policy"]
Algo = Literal["a2s", "a2c"]
Device = Literal["cpu", "cuda"]
# An update takes milliseconds and leaves most of the time to actors, which need not wait for it.
_OFF_POLICY = {"clock": "async", "checkpoint_every_updates": 2000}
_LISTS = ("env_kwargs", "wrappers", "info_metrics")
_RANGES: dict[str, tuple[float, float]] = {
    "total_steps": (1, math.inf),
    "seed": (0, 2**63 - 1),
    "n": (1, math.inf),
    "envs": (1, 4096),
    "action_repeat": (1, 1000),
    "frame_stack": (1, 1000),
    "max_episode_steps": (0, 2**31 - 1),
    "env_timeout_s": (0.001, 1e9),
    "checkpoint_every_updates": (1, math.inf),
    "keep_policy_every_updates": (0, math.inf),
    "threads": (1, math.inf),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """The options of a run.

    Raises:
        UsageError: A value is impossible; one line that names it.
    """

    run: str = "default"
    """Name of the run, a part of every key on the network."""
    env: str = "Hopper-v5"
    """Gymnasium id, module:Id-v0, module:Class, or FILE.py: with either."""
    env_kwargs: tuple[str, ...] = ()
    """KEY=VALUE of its constructor; a value is JSON, or else a text."""
    wrappers: tuple[str, ...] = ()
    """module:Class, or module:Class={JSON}, the innermost first."""
    action_repeat: int = 1
    """Steps of the environment for each action."""
    frame_stack: int = 1
    """Latest observations that a policy sees at once."""
    max_episode_steps: int = 0
    """Steps of the environment after which an episode is cut; 0: its own limit."""
    env_timeout_s: float = TIMEOUT_S
    """Seconds in which a call into an environment has to return."""
    info_metrics: tuple[str, ...] = ()
    """Keys of info whose numbers are kept with each episode; is_success always is."""
    variant: Variant = "on-policy"
    """On-policy (algorithm 1 of the paper) or off-policy (algorithm 2)."""
    algo: Algo = "a2s"
    """a2s, or a2c: one suggestion, no Q."""
    preset: str = "modern"
    """Named set of hyperparameters."""
    total_steps: int = 1_000_000
    """Environment steps at which the run ends."""
    seed: int = 0
    """Seed of everything."""
    clock: Clock = "lockstep"
    """lockstep: one version, one batch; async: actors do not wait for weights."""
    n: int = 1
    """Actor processes to wait for before the first weights."""
    envs: int = 8
    """Environments in each actor process."""
    checkpoint_every_updates: int = 20
    """Updates between checkpoints."""
    keep_policy_every_updates: int = 0
    """Updates between policies that are kept for good; 0 keeps none."""
    threads: int = 1
    """Threads of torch; small networks are fastest with one."""
    device: Device = "cpu"
    """Where off-policy networks learn; actors need no GPU."""

    def __post_init__(self) -> None:
        """Check every value against its type and range."""
        for name, hint in get_type_hints(type(self)).items():
            _require_type(name, getattr(self, name), hint)
        Keys(self.run)
        for name, (low, high) in _RANGES.items():
            if not low <= (number := getattr(self, name)) <= high:
                span = f"at least {low}" if high == math.inf else f"{low} to {high}"
                raise UsageError(f"{name}: found {number}, expected {span}")
        self.env_config()
        name, only = ("algo", "a2s") if self.variant == "off-policy" else ("device", "cpu")
        if (found := getattr(self, name)) != only:
            raise UsageError(f"{name}: found {found}, expected {only} with variant {self.variant}")

    def env_config(self) -> EnvConfig:
        """How the environment is made.

        Raises:
            UsageError: An argument or a wrapper cannot be read.
        """
        for setting in self.wrappers:
            wrapper_of(setting)
        try:
            return EnvConfig(
                env_id=self.env,
                kwargs=kwargs_of(self.env_kwargs),
                wrappers=self.wrappers,
                action_repeat=self.action_repeat,
                frame_stack=self.frame_stack,
                max_episode_steps=self.max_episode_steps,
                timeout_s=self.env_timeout_s,
                info_metrics=self.info_metrics,
            )
        except MalformedMessageError as error:
            raise UsageError(str(error)) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A run and its hyperparameters."""

    run: RunConfig
    hyper: OnPolicyHyper | OffPolicyHyper

    def to_toml(self) -> str:
        """Write everything, so that :func:`read` gives the same again."""
        document = tomlkit.document()
        document["run"] = {k: _plain(v) for k, v in asdict(self.run).items()}
        document["hyper"] = {k: _plain(v) for k, v in asdict(self.hyper).items()}
        return tomlkit.dumps(document)

    def sources(self) -> dict[str, Choice]:
        """Every value that the preset has, with its source."""
        if self.run.variant == "off-policy":
            return off_policy_presets.choices(self.run.preset, self.run.total_steps)
        return presets.choices(self.run.preset, self.run.algo)

    def changed(self) -> dict[str, object]:
        """The hyperparameters that are not those of the preset."""
        sources = self.sources()
        values = asdict(self.hyper)
        return {name: value for name, value in values.items() if value != sources[name].value}

    def explain(self) -> str:
        """Every value with its source, one a line, as TOML with comments."""
        sources, changed = self.sources(), self.changed()
        lines = ["[run]"]
        lines += [f"{k} = {_toml(v)}" for k, v in asdict(self.run).items()]
        lines += ["", "[hyper]"]
        for name, value in asdict(self.hyper).items():
            source = "set by you" if name in changed else sources[name].source
            lines.append(f"{name} = {_toml(value)}  # {source}")
        return "\n".join(lines)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the two tables of a configuration file; either may be missing or incomplete.

    Hyperparameters that are gone are left out where their value changed nothing.

    Raises:
        UsageError: The file cannot be read, or has an unknown table or option, or
            something else for a table.
    """
    try:
        document = tomllib.loads(path.read_text())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    for table, found in document.items():
        if table not in ("run", "hyper"):
            raise UsageError(f"{path}: unknown table [{table}]{nearest(table, ('run', 'hyper'))}")
        if not isinstance(found, dict):
            raise UsageError(f"{path}: {table}: found {found!r}, expected a table [{table}]")
    run, hyper = document.get("run", {}), document.get("hyper", {})
    valid = {field.name for field in fields(RunConfig)}
    for name in run:
        if name not in valid:
            raise UsageError(f"{path}: unknown option {name!r} in [run]{meant(name, valid, RUN)}")
    variant = run.get("variant", "on-policy")
    return run, without_removed(hyper, variant, _hyperparameters(variant))


def require_known(path: Path, hyper: Mapping[str, object], variant: object) -> None:
    """Check the names in the table ``hyper`` of a file.

    Raises:
        UsageError: One is none of this variant; the one that is meant is named.
    """
    if variant not in get_args(Variant):
        return  # and that is what is wrong
    valid = _hyperparameters(variant)
    others = OFF_POLICY if variant == "off-policy" else ON_POLICY
    for name in hyper:
        if name not in valid:
            raise UsageError(
                f"{path}: unknown hyperparameter {name!r} in [hyper]{meant(name, valid, others)}"
            )


def _hyperparameters(variant: object) -> set[str]:
    hyper = OffPolicyHyper if variant == "off-policy" else OnPolicyHyper
    return {field.name for field in fields(hyper)}


def assemble(options: Mapping[str, Any], hyper: Mapping[str, object]) -> Configuration:
    """Make a configuration of options and hyperparameters that differ from the defaults.

    Raises:
        UsageError: A name or a value is impossible.
    """
    options = {name: _exact(name, value) for name, value in options.items()}
    if options.get("variant") == "off-policy":
        run = RunConfig(**{**_OFF_POLICY, **options})
        made = off_policy_presets.off_policy(run.preset, hyper, run.total_steps)
        return Configuration(run=run, hyper=made)
    run = RunConfig(**options)
    return Configuration(run=run, hyper=presets.on_policy(run.preset, run.algo, hyper))


def parse_settings(settings: list[str]) -> dict[str, object]:
    """Split ``KEY=VALUE`` of ``--set``.

    Raises:
        UsageError: There is no ``=``.
    """
    parsed: dict[str, object] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise UsageError(f"--set: found {setting!r}, expected KEY=VALUE")
        parsed[name.strip()] = value.strip()
    return parsed


def _exact(name: str, value: object) -> object:
    """A file says 1e6 where a whole number is wanted, and has lists where we have tuples."""
    if name in _LISTS and isinstance(value, list):
        return tuple(value)
    if not isinstance(value, float) or get_type_hints(RunConfig).get(name) is not int:
        return value
    try:
        return whole(value)
    except ValueError:
        raise UsageError(f"{name}: found {value}, expected a whole number") from None


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: object) -> str:
    return tomlkit.item(_plain(value)).as_string()


def _require_type(name: str, value: object, hint: Any) -> None:
    if get_origin(hint) is tuple:
        if type(value) is not tuple or not all(isinstance(v, str) for v in value):
            raise UsageError(f"{name}: found {value!r}, expected a list of texts")
        return
    choices = get_args(hint)
    if choices and value not in choices:
        raise UsageError(f"{name}: found {value!r}{nearest(str(value), choices)}")
    if not choices and type(value) is not hint and (hint, type(value)) != (float, int):
        expected = {int: "a whole number", float: "a number"}.get(hint, "text")
        raise UsageError(f"{name}: found {value!r}, expected {expected}")
