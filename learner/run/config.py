"""The settings of a run, from the command line or a file, checked, and written down.

A configuration is two tables of TOML, as every run directory keeps it::

    [run]     environment, algorithm, lengths, seed: the options of the command line
    [hyper]   every hyperparameter, as `a2s learner --print-config` shows them
"""

import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import tomlkit

from a2s.learner.off_policy import config as off_policy_config
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.on_policy import presets as on_policy_presets
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.presets import AnyOnPolicyConfig
from a2s.learner.run.aliases import meant, option_meant, with_added, without_removed
from a2s.learner.run.run_config import RunConfig, Variant
from a2s.learner.settings import Preset
from a2s.protocol.errors import UsageError, nearest

Hyper = AnyOnPolicyConfig | OffPolicyConfig
C = TypeVar("C", bound=Hyper)
P = TypeVar("P")
# An update takes milliseconds and leaves most of the time to actors, which need not wait for it.
_OFF_POLICY = {"clock": "async", "checkpoint_every_updates": 2000}
_WARM_UP_PART = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A run and its hyperparameters."""

    run: RunConfig
    hyper: Hyper

    def to_toml(self) -> str:
        """Write everything, so that :func:`read` gives the same again."""
        document = tomlkit.document()
        document["run"] = {k: _plain(v) for k, v in asdict(self.run).items()}
        document["hyper"] = {k: _plain(v) for k, v in asdict(self.hyper).items()}
        return tomlkit.dumps(document)

    def changed(self) -> dict[str, object]:
        """The hyperparameters that are not those of the preset."""
        preset = asdict(_hyper(self.run, {}))
        return {name: v for name, v in asdict(self.hyper).items() if v != preset[name]}

    def explain(self) -> str:
        """Every value, hyperparameters with their sources, one a line, as TOML with comments."""
        changed, about = self.changed(), type(self.hyper).about()
        defaults = asdict(type(self.hyper)())
        source = _presets(self.run.variant)[self.run.preset].source
        lines = ["[run]"]
        lines += [f"{k} = {_toml(v)}" for k, v in asdict(self.run).items()]
        lines += ["", "[hyper]"]
        for name, value in asdict(self.hyper).items():
            of_preset = about[name].source if value == defaults[name] else source
            if name == "warm_up_steps" and value < defaults[name]:
                of_preset = "a tenth of a short run"
            comment = "set by you" if name in changed else of_preset or "the default"
            lines.append(f"{name} = {_toml(value)}  # {comment}")
        return "\n".join(lines)


def on_policy(preset: str, algo: str, given: Mapping[str, object]) -> AnyOnPolicyConfig:
    """Hyperparameters of a preset, a key of `a2s.learner.on_policy.presets.PRESETS`, some changed.

    ``algo`` is ``a2s`` or ``a2c``. The values in ``given`` have the right type or are text.

    Raises:
        UsageError: The preset or a name is unknown, or a value impossible.
    """
    config = _preset(on_policy_presets.PRESETS, preset).config
    changed = config.as_a2c() if algo == "a2c" else config
    hyper = _change(changed, given)
    for name, only in (("suggestions", 1), ("distil", "off")) if algo == "a2c" else ():
        if (found := getattr(hyper, name, only)) != only:
            raise UsageError(f"{name}: found {found}, expected {only} with algo a2c")
    return hyper


def off_policy(
    preset: str, given: Mapping[str, object], total_steps: int | None = None
) -> OffPolicyConfig:
    """Hyperparameters of a preset, a key of `a2s.learner.off_policy.config.PRESETS`, some changed.

    The values in ``given`` have the right type or are text. At most a tenth of the run's
    ``total_steps`` is warm-up.

    Raises:
        UsageError: The preset or a name is unknown, or a value impossible.
    """
    config = _preset(off_policy_config.PRESETS, preset).config
    if config.precision == "fastest":
        config = replace(config, precision=_fastest_precision())
    if total_steps is not None:
        tenth = max(1, total_steps // _WARM_UP_PART)
        config = replace(config, warm_up_steps=min(tenth, config.warm_up_steps))
    return _change(config, given)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the two tables of a configuration file; either may be missing or incomplete.

    Hyperparameters that were removed are left out where their value changed nothing; a file that
    states all but later ones is of a run from before them.

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
    valid = set(RunConfig.about())
    hyper_names = {*OnPolicyConfig.about(), *AuthorsConfig.about(), *OffPolicyConfig.about()}
    for name in run:
        if name not in valid:
            hint = " (it belongs in [hyper])" if name in hyper_names else option_meant(name, valid)
            raise UsageError(f"{path}: unknown option {name!r} in [run]{hint}")
    remaining = _remaining(run)
    return run, with_added(without_removed(hyper, *remaining), *remaining)


def require_known(path: Path, hyper: Mapping[str, object], variant: object, preset: object) -> None:
    """Check the names in the table ``hyper`` of a file.

    Raises:
        UsageError: One is not of this preset; the one that is meant is named.
    """
    presets = _presets(variant)
    if variant not in get_args(Variant) or str(preset) not in presets:
        return  # which is refused later
    _require_names(presets[str(preset)].config, hyper, f"{path}: ", " in [hyper]")


def assemble(options: Mapping[str, Any], hyper: Mapping[str, object]) -> Configuration:
    """Make a configuration of options and hyperparameters that differ from the defaults.

    Raises:
        UsageError: A name or a value is impossible.
    """
    given = {**(_OFF_POLICY if options.get("variant") == "off-policy" else {}), **options}
    try:
        run = RunConfig(**RunConfig.parse(given))
    except ValueError as error:
        raise UsageError(str(error)) from None
    return Configuration(run=run, hyper=_hyper(run, hyper))


def recovery_of(preset: str, *, on: bool) -> str:
    """The recovery rule that a preset has for a2s, for a2c with recovery; or ``off``."""
    return on_policy(preset, "a2s", {}).recovery if on else "off"


def parse_settings(settings: list[str]) -> dict[str, object]:
    """Split ``KEY=VALUE`` of ``--set``.

    Raises:
        UsageError: There is no ``=``.
    """
    parsed: dict[str, object] = {}
    for each in settings:
        name, equals, value = each.partition("=")
        if not equals:
            raise UsageError(f"--set: found {each!r}, expected KEY=VALUE")
        parsed[name.strip()] = value.strip()
    return parsed


def _hyper(run: RunConfig, given: Mapping[str, object]) -> Hyper:
    if run.variant == "off-policy":
        return off_policy(run.preset, given, run.total_steps)
    return on_policy(run.preset, run.algo, given)


def _remaining(run: Mapping[str, Any]) -> tuple[str, Collection[str]]:
    """The key of what was removed from the hyperparameters of a run, and those that remain."""
    if run.get("variant") == "off-policy":
        return "off-policy", OffPolicyConfig.about()
    if run.get("preset") in ("authors", "paper"):
        return "authors", AuthorsConfig.about()
    return "on-policy", OnPolicyConfig.about()


def _presets(variant: object) -> Mapping[str, Preset[Any]]:
    return off_policy_config.PRESETS if variant == "off-policy" else on_policy_presets.PRESETS


def _elsewhere(config: Hyper) -> dict[str, str]:
    """Where the hyperparameters are that a configuration does not have."""
    without_option = {"checkpoint_every_updates": "in [run] of --config"}
    if isinstance(config, OffPolicyConfig):
        others = dict.fromkeys([*OnPolicyConfig.about(), *AuthorsConfig.about()], "on-policy")
        return others | without_option
    found = dict.fromkeys(OffPolicyConfig.about(), "with --variant off-policy") | without_option
    if isinstance(config, AuthorsConfig):
        return found | dict.fromkeys(OnPolicyConfig.about(), "with --preset modern")
    return found | dict.fromkeys(AuthorsConfig.about(), "with --preset authors or paper")


def _preset(presets: Mapping[str, P], name: str) -> P:
    if name in presets:
        return presets[name]
    hint = nearest(name, presets)
    if name in off_policy_config.PRESETS:
        hint = " (only with --variant off-policy)"
    elif name in on_policy_presets.PRESETS:
        hint = " (only on-policy)"
    raise UsageError(f"unknown preset {name!r}{hint}")


def _require_names(config: Hyper, names: Iterable[str], file: str = "", table: str = "") -> None:
    valid = config.about()
    variant = "off-policy" if isinstance(config, OffPolicyConfig) else "on-policy"
    for name in names:
        if name not in valid:
            hint = meant(name, valid, variant, _elsewhere(config))
            raise UsageError(f"{file}unknown hyperparameter {name!r}{table}{hint}")


def _change(config: C, given: Mapping[str, object]) -> C:
    _require_names(config, given)
    try:
        return replace(config, **config.parse(given))
    except ValueError as error:
        raise UsageError(str(error)) from None


def _fastest_precision() -> Literal["bf16", "f32"]:
    processor = Path("/proc/cpuinfo")  # torch could say, but takes seconds to import
    return fastest_precision(processor.read_text() if processor.exists() else "")


def fastest_precision(cpuinfo: str) -> Literal["bf16", "f32"]:
    """Which products are faster on a processor, by Linux's ``/proc/cpuinfo`` (docs/adr/0029).

    Not measured: a run that is repeated on the same machine must come to the same bits.
    """
    words = set(cpuinfo.split())
    vectors = "avx512_bf16" in words and "AuthenticAMD" in words
    return "bf16" if vectors or "amx_bf16" in words else "f32"


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: object) -> str:
    return tomlkit.item(_plain(value)).as_string()
