"""Named sets of off-policy hyperparameters, and where each value comes from.

``modern`` is meant for use: ten suggestions to act by, critics of quantiles, residual networks.
``sac`` is SAC with normalised observations: one suggestion, two values, plain networks.
``paper`` is algorithm 2 of the paper as printed.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from a2s.learner.networks.options import Precision
from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.on_policy.presets import Choice
from a2s.learner.run.other_names import OFF_POLICY
from a2s.learner.run.overrides import parse_all
from a2s.protocol.errors import UsageError, nearest

_PAPER = "paper, table 3"
_BOX = "paper, algorithm 2"
_SAC = "SAC (Haarnoja et al. 2018), table 1"
_FASTER = "CrossQ (Bhatt et al. 2024): normalised critics bear it; docs/adr/0008"
_UNUSED = "not used here"
_FASTEST = "fastest"
_BF16_FLAGS = {"avx512_bf16", "amx_bf16"}
_WARM_UP_PART = 10
_TQC = "TQC (Kuznetsov et al. 2020), section 4; docs/adr/0009"

_MODERN: dict[str, Choice] = {
    "act_suggestions": Choice(10, _PAPER),
    "selection": Choice("soft", "hard ones explore too little; docs/adr/0011"),
    "target_suggestions": Choice(1, "4 cost a quarter and gained nothing; docs/adr/0008"),
    "target_groups": Choice(1, "a batch is a mean already"),
    "selector": Choice("one", "the maximum of what also evaluates is biased upwards"),
    "critics": Choice(2, "TD3 (Fujimoto et al. 2018)"),
    "quantiles": Choice(25, _TQC),
    "dropped_quantiles": Choice(2, _TQC),
    "huber_width": Choice(0.02, "a few units of return, as TQC's 1; docs/adr/0012"),
    "network": Choice("residual", "SimBa (Lee et al. 2024); docs/adr/0009"),
    "critic_sizes": Choice((256, 256), _SAC),
    "policy_sizes": Choice((256, 256), _SAC),
    "layer_norm": Choice(True, "Nauman et al. 2024: above remedies particular to RL"),
    "normalise_obs": Choice(True, "SimBa (Lee et al. 2024)"),
    "quiet_rare_obs": Choice(True, "contact forces drown the rest; docs/adr/0016"),
    "normalise_return": Choice(True, "SimbaV2 (Lee et al. 2025); docs/adr/0012"),
    "precision": Choice(
        _FASTEST, "of this machine: bf16 if the processor multiplies it (AVX-512, AMX)"
    ),
    "policy_loss": Choice("pathwise", _SAC),
    "distil_suggestions": Choice(4, "where policy_loss is score"),
    "entropy_per_action": Choice(-1.0, _SAC),
    "initial_temperature": Choice(0.01, "SimbaV2 (Lee et al. 2025); docs/adr/0012"),
    "temperature_learning_rate": Choice(3e-4, "SAC; 1e-3 explores too little; docs/adr/0014"),
    "average_updates": Choice(1000, "the latest mean action falls now and then; docs/adr/0010"),
    "gamma": Choice(0.995, "at 0.99 a fall costs too little; docs/adr/0015"),
    "tau": Choice(0.02, "faster from the start in every probe; docs/adr/0009"),
    "n_step": Choice(1, _SAC),
    "batch_rows": Choice(256, _SAC),
    "updates_per_step": Choice(1.0, _SAC),
    "learning_rate": Choice(1e-3, _FASTER),
    "critic_learning_rate": Choice(1e-3, _FASTER),
    "warm_up_steps": Choice(5000, "CleanRL; REDQ (Chen et al. 2021)"),
    "replay_rows": Choice(1_000_000, _SAC),
    "prioritised": Choice(False, "large errors of a maximum are its optimism too"),
    "priority_exponent": Choice(0.6, "Schaul et al. 2016, table 3"),
    "importance_exponent": Choice(0.4, "Schaul et al. 2016, table 3"),
    "send_every_steps": Choice(8, "a round of 16 environments is then 128 steps"),
    "lead_steps": Choice(16, "at 256 actors play weights 250 updates old; docs/adr/0013"),
}

_SAC_TEXT: dict[str, Choice] = _MODERN | {
    "act_suggestions": Choice(1, "SAC has one"),
    "selection": Choice("hard", _UNUSED),
    "average_updates": Choice(0, _SAC),
    "gamma": Choice(0.99, _SAC),
    "tau": Choice(0.005, _SAC),
    "quantiles": Choice(1, "SAC's critics have one value"),
    "dropped_quantiles": Choice(0, _UNUSED),
    "network": Choice("mlp", _SAC),
    "normalise_return": Choice(False, _SAC),
    "huber_width": Choice(1.0, _UNUSED),
    "initial_temperature": Choice(0.1, "from 1 it is 5,000 updates on the way; docs/adr/0008"),
    "temperature_learning_rate": Choice(1e-3, _FASTER),
}

_PAPER_TEXT: dict[str, Choice] = _MODERN | {
    "selection": Choice("hard", _BOX),
    "quantiles": Choice(1, _BOX),
    "dropped_quantiles": Choice(0, _UNUSED),
    "network": Choice("mlp", _BOX),
    "target_suggestions": Choice(10, _PAPER),
    "target_groups": Choice(3, "paper, section 4.2: low; the authors' code has 1 to 3"),
    "selector": Choice("mean", "there is one critic"),
    "critics": Choice(1, _BOX),
    "critic_sizes": Choice((128, 64), "paper, section 5"),
    "policy_sizes": Choice((64, 64), "paper, section 5"),
    "normalise_obs": Choice(False, "authors' code"),
    "quiet_rare_obs": Choice(False, _UNUSED),
    "normalise_return": Choice(False, _BOX),
    "huber_width": Choice(1.0, _UNUSED),
    "layer_norm": Choice(True, "authors' code"),
    "precision": Choice("f32", "networks too small to gain"),
    "policy_loss": Choice("score", _BOX),
    "distil_suggestions": Choice(10, "V is the mean of Q over K suggestions"),
    "entropy_per_action": Choice(-1.0, _UNUSED),
    "initial_temperature": Choice(0.0, _BOX),
    "temperature_learning_rate": Choice(0.0, _BOX),
    "average_updates": Choice(0, _BOX),
    "gamma": Choice(0.97, _PAPER),
    "tau": Choice(1.0, "paper, algorithm 2: no target network"),
    "learning_rate": Choice(1e-3, "authors' code"),
    "critic_learning_rate": Choice(1e-3, "authors' code"),
    "warm_up_steps": Choice(1000, "the box has none; an untrained Q prefers one direction"),
}

PRESETS: dict[str, dict[str, Choice]] = {
    "modern": _MODERN,
    "sac": _SAC_TEXT,
    "paper": _PAPER_TEXT,
}
_FIELDS: dict[str, Any] = {field.name: field.type for field in dataclasses.fields(OffPolicyHyper)}


def choices(preset: str, total_steps: int | None = None) -> dict[str, Choice]:
    """Every value of a preset with its source.

    Args:
        preset: A key of `PRESETS`.
        total_steps: Of the run, of which at most a tenth is warm-up.

    Raises:
        UsageError: There is no such preset; the nearest is named.
    """
    if preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}{nearest(preset, PRESETS)}")
    found = dict(PRESETS[preset])
    if found["precision"].value == _FASTEST:
        found["precision"] = found["precision"]._replace(value=_fastest_precision())
    if total_steps is not None:
        most, part = found["warm_up_steps"].value, max(1, total_steps // _WARM_UP_PART)
        assert isinstance(most, int)
        if part < most:
            found["warm_up_steps"] = Choice(part, "a tenth of a short run")
    return found


def _fastest_precision() -> Precision:
    processor = Path("/proc/cpuinfo")  # torch could say, but takes seconds to import
    flags = processor.read_text().split() if processor.exists() else []
    return "bf16" if _BF16_FLAGS.intersection(flags) else "f32"


def off_policy(
    preset: str, overrides: Mapping[str, object], total_steps: int | None = None
) -> OffPolicyHyper:
    """Hyperparameters of a preset with some of them overridden.

    Args:
        preset: A key of `PRESETS`.
        overrides: Values by name, of the right type or as text.
        total_steps: Of the run, of which at most a tenth is warm-up.

    Raises:
        UsageError: A preset or name is unknown, or a value is out of range.
    """
    values = {name: choice.value for name, choice in choices(preset, total_steps).items()}
    given = parse_all(overrides, _FIELDS, OFF_POLICY)
    return OffPolicyHyper(**values | given)  # type: ignore[arg-type]
