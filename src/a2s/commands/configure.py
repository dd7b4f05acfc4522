"""From options to a configuration: the one path for ``learner`` and ``train``."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from a2s.learner import configuration, run_directory
from a2s.learner.configuration import Configuration
from a2s.learner.presets import recovery_of
from a2s.protocol.errors import UsageError

ROOT = Path("runs")


def configure(
    options: dict[str, Any],
    settings: list[str] | None,
    config: Path | None,
    run_dir: Path | None,
    *,
    resume: bool,
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Configuration, Path]:
    """Put file and options together, and decide where the run is kept.

    Args:
        options: Of the command line; ``None`` where not given. ``lockstep`` stands for the clock,
            ``suggestions`` and ``recovery`` for hyperparameters.
        settings: ``KEY=VALUE`` hyperparameters.
        config: A configuration file; a resumed run has its own.
        run_dir: Directory of the run, if the user names one.
        resume: Whether to go on with an existing run.
        defaults: Of the command, where they differ from those of a run.

    Raises:
        UsageError: Something is unknown, impossible or in use.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if "lockstep" in given:
        given["clock"] = "lockstep" if given.pop("lockstep") else "async"
    hyper = configuration.parse_settings(settings or [])
    if resume:
        path = run_directory.choose(ROOT, given.get("run", "default"), run_dir, resume=True)
        config = config or path / run_directory.CONFIG
    run_table, hyper_table = configuration.read(config) if config is not None else ({}, {})
    variant = given.get("variant", run_table.get("variant", "on-policy"))
    preset = given.get("preset", run_table.get("preset", "modern"))
    _move_shorthands(given, hyper, variant, preset)
    # A complete file states every value; another preset or algorithm means its own values.
    if any(
        run_table.get(name, given[name]) != given[name]
        for name in ("preset", "algo", "variant")
        if name in given
    ):
        hyper_table = {}
    if config is not None:
        configuration.require_known(config, hyper_table, variant)
    assembled = configuration.assemble({**defaults, **run_table, **given}, {**hyper_table, **hyper})
    if not resume:
        path = run_directory.choose(ROOT, assembled.run.run, run_dir, resume=False)
    return assembled, path


def _move_shorthands(
    given: dict[str, Any], hyper: dict[str, object], variant: str, preset: str
) -> None:
    """Move the options that stand for hyperparameters to these."""
    if "suggestions" in given:
        name = "act_suggestions" if variant == "off-policy" else "suggestions"
        hyper[name] = given.pop("suggestions")
    if "recovery" in given:
        if variant == "off-policy":
            raise UsageError("--recovery: only on-policy learning has recoveries; leave it out")
        hyper.setdefault("recovery", recovery_of(preset, on=given.pop("recovery")))
