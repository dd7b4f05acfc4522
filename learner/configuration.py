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
from typing import Any, Literal, get_args, get_type_hints

import tomlkit

from a2s.learner import off_policy_presets, presets
from a2s.learner.algorithm.hyperparameters import OnPolicyHyper
from a2s.learner.algorithm.off_policy_hyper import OffPolicyHyper
from a2s.learner.presets import Choice
from a2s.protocol.errors import UsageError, nearest
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Clock

Variant = Literal["on-policy", "off-policy"]
Algo = Literal["a2s", "a2c"]
Device = Literal["cpu", "cuda"]
# An update takes milliseconds and leaves most of the time to actors, which need not wait for it.
_OFF_POLICY = {"clock": "async", "checkpoint_every_updates": 2000}
_RANGES: dict[str, tuple[int, float]] = {
    "total_steps": (1, math.inf),
    "seed": (0, 2**63 - 1),
    "n": (1, math.inf),
    "envs": (1, 4096),
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
    """Gymnasium id, or module:Id-v0."""
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
        hints = get_type_hints(type(self))
        for name, hint in hints.items():
            value, choices = getattr(self, name), get_args(hint)
            if choices and value not in choices:
                raise UsageError(f"{name}: found {value!r}{nearest(str(value), choices)}")
            if not choices and type(value) is not hint:
                raise UsageError(f"{name}: found {value!r}, expected {hint.__name__}")
        Keys(self.run)
        for name, (low, high) in _RANGES.items():
            if not low <= (number := getattr(self, name)) <= high:
                span = f"at least {low}" if high == math.inf else f"{low} to {high}"
                raise UsageError(f"{name}: found {number}, expected {span}")
        name, only = ("algo", "a2s") if self.variant == "off-policy" else ("device", "cpu")
        if (found := getattr(self, name)) != only:
            raise UsageError(f"{name}: found {found}, expected {only} with variant {self.variant}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A run and its hyperparameters."""

    run: RunConfig
    hyper: OnPolicyHyper | OffPolicyHyper

    def to_toml(self) -> str:
        """Write everything, so that :func:`read` gives the same again."""
        document = tomlkit.document()
        document["run"] = asdict(self.run)
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
            raise UsageError(f"{path}: unknown option {name!r} in [run]{nearest(name, valid)}")
    return run, hyper


def require_known(path: Path, hyper: Mapping[str, object], variant: object) -> None:
    """Check the names in the table ``hyper`` of a file.

    Raises:
        UsageError: One is none of this variant; the nearest is named.
    """
    if variant not in get_args(Variant):
        return  # and that is what is wrong
    kind = OffPolicyHyper if variant == "off-policy" else OnPolicyHyper
    valid = {field.name for field in fields(kind)}
    for name in hyper:
        if name not in valid:
            raise UsageError(
                f"{path}: unknown hyperparameter {name!r} in [hyper]{nearest(name, valid)}"
            )


def assemble(options: Mapping[str, Any], hyper: Mapping[str, object]) -> Configuration:
    """Make a configuration of options and hyperparameters that differ from the defaults.

    Raises:
        UsageError: A name or a value is impossible.
    """
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


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: object) -> str:
    return tomlkit.item(_plain(value)).as_string()
