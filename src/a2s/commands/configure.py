"""From options to a configuration: the one path for ``learner`` and ``train``."""

import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from a2s.learner.run import config as configuration
from a2s.learner.run.choice import choose
from a2s.learner.run.config import Configuration, recovery_of
from a2s.learner.run.directory import CONFIG, claimed
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.env_config import EnvConfig, kwargs_of, wrapper_of
from a2s.protocol.errors import A2SError, MalformedMessageError, UsageError

ROOT = Path("runs")


def configure(
    options: dict[str, Any],
    settings: list[str] | None,
    config: Path | None,
    run_dir: Path | None,
    *,
    resume: bool,
    defaults: Mapping[str, Any] = MappingProxyType({}),
    yielding: Collection[str] = (),
) -> tuple[Configuration, Path]:
    """Combine file and options, and choose the directory of the run.

    ``options`` are ``None`` where not given; ``lockstep`` stands for the clock, ``suggestions`` and
    ``recovery`` for hyperparameters. ``settings`` are hyperparameters, ``KEY=VALUE``. A resumed run
    has its own configuration file. ``defaults`` are the command's, where they differ from those of
    a run. Shorthands that are ``yielding`` give way to ``settings``, the others do not.

    Raises:
        UsageError: Something is unknown, impossible or in use.
    """
    given = _given(options)
    hyper = configuration.parse_settings(settings or [])
    is_of_user = config is not None
    if resume:
        path = choose(ROOT, given.get("run", "default"), run_dir, resume=True)
        config = config or path / CONFIG
    run_table, hyper_table = configuration.read(config) if config is not None else ({}, {})
    variant = given.get("variant", run_table.get("variant", "on-policy"))
    preset = str(given.get("preset", run_table.get("preset", "modern")))
    hyper |= {
        name: value
        for name, (shorthand, value) in _take_shorthands(given, variant, preset).items()
        if not (name in hyper and shorthand in yielding)
    }
    # A complete file states every value; another preset or algorithm means its own values.
    if any(
        run_table.get(name, given[name]) != given[name]
        for name in ("preset", "algo", "variant")
        if name in given
    ):
        hyper_table = {}
    if config is not None:
        configuration.require_known(config, hyper_table, variant, preset)
    assembled = configuration.assemble({**defaults, **run_table, **given}, {**hyper_table, **hyper})
    if is_of_user:
        assembled = replace(assembled, run=_all_placed(assembled.run))
    if not resume:
        path = choose(ROOT, assembled.run.run, run_dir, resume=False)
    return assembled, path.absolute()


def unfinished(run: str) -> Path | None:
    """The newest run of this name, if it has not ended and no learner is at work there."""
    try:
        path = choose(ROOT, run, None, resume=True)
        with claimed(path):
            summary = path / "summary.json"
            has_ended = summary.exists() and json.loads(summary.read_text())["finished"]
    except (A2SError, OSError, ValueError, KeyError, TypeError):  # none that could go on
        return None
    return None if has_ended else path


def placed(env: str) -> str:
    """Name the file of an environment, if it is one, from any working directory."""
    place, py, name = env.partition(".py:")
    return f"{Path(place).absolute()}{py}{name}" if py and "=" not in place else env


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options that are given, as a file would have them."""
    given = {name: value for name, value in options.items() if value is not None}
    if "env" in given:
        given["env"] = placed(given["env"])
    if "wrappers" in given:
        given["wrappers"] = tuple(placed(wrapper) for wrapper in given["wrappers"])
    if "lockstep" in given:
        given["clock"] = "lockstep" if given.pop("lockstep") else "async"
    return given


def _all_placed(run: RunConfig) -> RunConfig:
    """Name all that a file has named from here, as options are, from any working directory."""
    init_from, prior = (x and str(Path(x).absolute()) for x in (run.init_from, run.prior))
    env, wrappers = placed(run.env), tuple(map(placed, run.wrappers))
    return replace(run, env=env, wrappers=wrappers, init_from=init_from, prior=prior)


def environment_of(options: Mapping[str, Any], known: EnvConfig | None = None) -> EnvConfig:
    """Make the configuration of an environment from options alone, ``None`` where not given.

    They are those of `a2s.commands.groups.ENVIRONMENT`. ``known``, a run's,
    fills in missing ones; it is ignored for another ``env``, and constructor arguments are added to
    its own.

    Raises:
        UsageError: An option is impossible, or there is no environment.
    """
    given = {name: value for name, value in options.items() if value is not None}
    env = placed(given.pop("env")) if "env" in given else None
    if env is None and known is None:
        raise UsageError("the policy does not say its environment; name it with --env")
    if env is not None:
        is_known = known is not None and Path(env).name == Path(known.env_id).name
        known = replace(known, env_id=env) if known and is_known else EnvConfig(env_id=env)
    assert known is not None
    for setting in given.get("wrappers", ()):
        wrapper_of(setting)
    if "env_kwargs" in given:
        added = json.loads(kwargs_of(given.pop("env_kwargs")))
        given["kwargs"] = json.dumps({**json.loads(known.kwargs), **added})
    if "wrappers" in given:
        given["wrappers"] = tuple(placed(wrapper) for wrapper in given["wrappers"])
    if "env_timeout_s" in given:
        given["timeout_s"] = given.pop("env_timeout_s")
    try:
        return replace(known, **given)
    except MalformedMessageError as error:
        raise UsageError(str(error)) from None


def _take_shorthands(
    given: dict[str, Any], variant: str, preset: str
) -> dict[str, tuple[str, object]]:
    """Take shorthands out: by the hyperparameter that each stands for, its name and value."""
    found: dict[str, tuple[str, object]] = {}
    if "suggestions" in given:
        name = "act_suggestions" if variant == "off-policy" else "suggestions"
        found[name] = "suggestions", given.pop("suggestions")
    if "recovery" in given:
        if variant == "off-policy":
            raise UsageError("--recovery: only on-policy learning has recoveries; leave it out")
        found["recovery"] = "recovery", recovery_of(preset, on=given.pop("recovery"))
    return found
