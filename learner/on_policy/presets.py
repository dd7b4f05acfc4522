"""Named sets of hyperparameters, and where each value comes from.

``modern`` is meant for use, ``authors`` repeats the paper's published code, ``paper`` its text.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from a2s.learner.on_policy.hyperparameters import OnPolicyHyper
from a2s.learner.run.other_names import ON_POLICY
from a2s.learner.run.overrides import parse_all
from a2s.protocol.errors import UsageError, nearest


class Choice(NamedTuple):
    """A value, and where it comes from."""

    value: object
    source: str


_PAPER = "paper, table 3"
_CODE = "authors' code"
_UNUSED = "not used here"
_PPO = "PPO paper, table 3"
_OURS = "ours, to be tuned"

_MODERN: dict[str, Choice] = {
    "suggestions": Choice(10, _PAPER),
    "selection": Choice("soft", "probe on Hopper: a hard argmax leaves the mean behind"),
    "temperature": Choice(3.0, "measured: at 1 the weights leave a third of the batch, adr/0006"),
    "selection_fades": Choice(True, "measured on HalfCheetah: else the mean action is left behind"),
    "action_mode": Choice("clip", "environments charge for what they are given"),
    "warm_up": Choice("first-fit", "the argmax of an untrained Q is an arbitrary direction"),
    "batch_steps": Choice(2048, _PPO),
    "batch_steps_first": Choice(256, "measured: InvertedPendulum is solved in 15 small batches"),
    "batch_growth": Choice(1.1, "measured, with the size of the first batch"),
    "min_episodes": Choice(0, "batches are counted in steps"),
    "whole_episodes": Choice(False, "cut episodes are bootstrapped"),
    "max_policy_lag": Choice(1, "acting and learning at the same time"),
    "gamma": Choice(0.99, _PPO),
    "gae_lambda": Choice(0.95, _PPO),
    "time_limit_is_terminal": Choice(False, "Pardo et al. 2018"),
    "normalise_obs": Choice(True, "Andrychowicz et al. 2021"),
    "normalise_return": Choice(True, "Andrychowicz et al. 2021"),
    "return_window_steps": Choice(20480, "ten batches"),
    "policy_sizes": Choice((64, 64), "paper, section 5"),
    "value_sizes": Choice((64, 64), "paper, section 5"),
    "q_sizes": Choice((128, 64), "paper, section 5"),
    "layer_norm": Choice(True, _CODE),
    "init": Choice("orthogonal", "Andrychowicz et al. 2021"),
    "std": Choice(0.5, _PAPER),
    "learn_std": Choice(True, _PPO),
    "std_floor": Choice(0.15, "selection shrinks a learned std"),
    "fit_rule": Choice("epochs", "a threshold on raw losses fails at other scales of reward"),
    "critic_epochs": Choice(10, _PPO),
    "least_minibatches": Choice(8, "measured: InvertedPendulum solved in 4,400 steps, not 8,500"),
    "critic_minibatch": Choice(256, "as the policy"),
    "fit_steps": Choice(100, _UNUSED),
    "q_fit_extra_steps": Choice(0, _UNUSED),
    "value_fit_extra_steps": Choice(0, _UNUSED),
    "fit_threshold": Choice(0.0, _UNUSED),
    "advantage": Choice("gae", "Schulman et al. 2016"),
    "normalise_advantage": Choice(True, "common practice"),
    "policy_loss": Choice("clip", "PPO paper, equation 7"),
    "clip_ratio": Choice(0.2, _PPO),
    "weight_limit": Choice(5.0, "measured: without weights the std shrinks, Hopper stalls"),
    "entropy_weight": Choice(0.0, _PPO),
    "policy_epochs": Choice(10, _PPO),
    "policy_minibatch": Choice(256, "measured: 64 and 128 no better on HalfCheetah, and slower"),
    "kl_stop": Choice(0.05, "bounds the whole update, equation 6 included"),
    "distil": Choice("off", "measured: it follows the noise of Q, adr/0006"),
    "distil_suggestions": Choice(10, _UNUSED),
    "distil_top": Choice(1, _UNUSED),
    "distil_steps": Choice(50, _UNUSED),
    "distil_minibatch": Choice(128, _UNUSED),
    "distil_kl": Choice(0.02, _UNUSED),
    "recovery": Choice("invariant", "equation 5 needs positive returns"),
    "recovery_bias": Choice(0.5, _OURS),
    "recovery_statistic": Choice("mean", "a single lucky episode sets a maximum for ever"),
    "recovery_episodes": Choice(50, "measured: the mean of 10 falls to half by chance, adr/0006"),
    "recovery_offset": Choice(0.0, "not needed by the invariant rule"),
    "recovery_cool_down": Choice(3, _OURS),
    "recovery_restores": Choice("everything", "the momentum led to the crash"),
    "recovery_learns": Choice(False, "the batch is of other networks"),
    "recovery_lr_divisor": Choice(2.0, _OURS),
    "recovery_kl_divisor": Choice(1.0, "nothing undoes it"),
    "learning_rate": Choice(5e-4, "measured: 1e-3 no better on InvertedPendulum"),
    "critic_learning_rate": Choice(5e-4, "as the policy"),
    "critic_follows_rule": Choice(False, _OURS),
    "lr_rule": Choice("anneal", "common practice"),
    "lr_min": Choice(1e-5, _OURS),
    "lr_max": Choice(3e-3, _OURS),
    "kl_target": Choice(0.01, _OURS),
    "kl_scope": Choice("update", "equation 6 moves the policy too"),
    "kl_dims": Choice("joint", "the divergence of the densities"),
    "max_grad_norm": Choice(0.5, "common practice"),
}

_AUTHORS: dict[str, Choice] = _MODERN | {
    "selection": Choice("hard", "paper, algorithm 1"),
    "temperature": Choice(1.0, _UNUSED),
    "selection_fades": Choice(False, _UNUSED),
    "action_mode": Choice("raw", _CODE),
    "warm_up": Choice("none", _CODE),
    "batch_steps": Choice(500, _CODE),
    "batch_steps_first": Choice(500, _CODE),
    "batch_growth": Choice(1.0, _CODE),
    "min_episodes": Choice(3, _CODE),
    "whole_episodes": Choice(True, "paper, algorithm 1"),
    "max_policy_lag": Choice(0, _CODE),
    "gamma": Choice(0.97, _PAPER),
    "gae_lambda": Choice(1.0, "paper, section 4.1"),
    "time_limit_is_terminal": Choice(True, _CODE),
    "normalise_obs": Choice(False, _CODE),
    "normalise_return": Choice(False, _CODE),
    "return_window_steps": Choice(20480, _UNUSED),
    "init": Choice("uniform", _CODE),
    "learn_std": Choice(False, _PAPER),
    "std_floor": Choice(0.3, _CODE),
    "fit_rule": Choice("threshold", _CODE),
    "critic_epochs": Choice(10, _UNUSED),
    "least_minibatches": Choice(1, _UNUSED),
    "critic_minibatch": Choice(128, _CODE),
    "fit_steps": Choice(100, _CODE),
    "q_fit_extra_steps": Choice(5000, _CODE),
    "value_fit_extra_steps": Choice(100, _CODE),
    "fit_threshold": Choice(100.0, _CODE),
    "advantage": Choice("return-v", "paper, section 4"),
    "normalise_advantage": Choice(False, _CODE),
    "policy_loss": Choice("score", "paper, equation 4"),
    "clip_ratio": Choice(0.2, _UNUSED),
    "weight_limit": Choice(0.0, "the selection is ignored, paper, section 4"),
    "entropy_weight": Choice(0.0, _CODE),
    "policy_epochs": Choice(1, _CODE),
    "policy_minibatch": Choice(0, _CODE),
    "kl_stop": Choice(float("inf"), _CODE),
    "distil": Choice("separate", _CODE),
    "distil_suggestions": Choice(10, _PAPER),
    "distil_top": Choice(1, "paper, equation 6"),
    "distil_steps": Choice(50, _CODE),
    "distil_minibatch": Choice(128, _CODE),
    "distil_kl": Choice(float("inf"), _CODE),
    "recovery": Choice("authors", "paper, equation 5"),
    "recovery_bias": Choice(0.65, _PAPER),
    "recovery_statistic": Choice("max", _CODE),
    "recovery_episodes": Choice(0, _CODE),
    "recovery_offset": Choice(100.0, _CODE),
    "recovery_cool_down": Choice(0, _CODE),
    "recovery_restores": Choice("networks", _CODE),
    "recovery_learns": Choice(True, _CODE),
    "recovery_lr_divisor": Choice(5.0, _CODE),
    "recovery_kl_divisor": Choice(1.1, _CODE),
    "learning_rate": Choice(1e-3, _CODE),
    "critic_learning_rate": Choice(1e-3, _CODE),
    "critic_follows_rule": Choice(True, _CODE),
    "lr_rule": Choice("kl", "paper, section 4.1.1"),
    "lr_min": Choice(0.0, _CODE),
    "lr_max": Choice(float("inf"), _CODE),
    "kl_target": Choice(1e-3, _PAPER),
    "kl_scope": Choice("policy-gradient", _CODE),
    "kl_dims": Choice("mean", _CODE),
    "max_grad_norm": Choice(0.0, _CODE),
}

_PAPER_TEXT: dict[str, Choice] = _AUTHORS | {
    "batch_steps": Choice(1, "paper, algorithm 1: one episode"),
    "batch_steps_first": Choice(1, "paper, algorithm 1: one episode"),
    "min_episodes": Choice(1, "paper, algorithm 1"),
    "advantage": Choice("q-v", "paper, algorithm 1"),
    "recovery_statistic": Choice("mean", "paper, section 4.1.1"),
    "recovery_offset": Choice(0.0, "paper, equation 5"),
    "recovery_learns": Choice(False, "paper, section 4.1.1"),
}

PRESETS: dict[str, dict[str, Choice]] = {
    "modern": _MODERN,
    "authors": _AUTHORS,
    "paper": _PAPER_TEXT,
}

_A2C: dict[str, Choice] = {
    "suggestions": Choice(1, "algo a2c"),
    "distil": Choice("off", "algo a2c"),
    "recovery": Choice("off", "algo a2c"),
}
_FIELDS: dict[str, Any] = {field.name: field.type for field in dataclasses.fields(OnPolicyHyper)}


def choices(preset: str, algo: str) -> dict[str, Choice]:
    """Every value of a preset with its source.

    Args:
        preset: A key of `PRESETS`.
        algo: ``a2s``, or ``a2c``: one suggestion, no Q, neither equation 5 nor 6.

    Raises:
        UsageError: There is no such preset or algorithm; the nearest is named.
    """
    if preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}{nearest(preset, PRESETS)}")
    if algo not in ("a2s", "a2c"):
        raise UsageError(f"unknown algo {algo!r}{nearest(algo, ('a2s', 'a2c'))}")
    table = PRESETS[preset]
    if algo == "a2s":
        return dict(table)
    reads_q = table["advantage"].value == "q-v"
    return table | _A2C | ({"advantage": Choice("return-v", "algo a2c")} if reads_q else {})


def on_policy(preset: str, algo: str, overrides: Mapping[str, object]) -> OnPolicyHyper:
    """Hyperparameters of a preset with some of them overridden.

    Args:
        preset: A key of `PRESETS`.
        algo: ``a2s`` or ``a2c``.
        overrides: Values by name, of the right type or as text.

    Raises:
        UsageError: A preset, algorithm or name is unknown, or a value is out of range.
    """
    values = {name: choice.value for name, choice in choices(preset, algo).items()}
    given = parse_all(overrides, _FIELDS, ON_POLICY)
    for name in ("suggestions", "distil") if algo == "a2c" else ():
        if name in given and given[name] != _A2C[name].value:
            raise UsageError(
                f"{name}: found {given[name]}, expected {_A2C[name].value} with algo a2c"
            )
    return OnPolicyHyper(**values | given)  # type: ignore[arg-type]


def recovery_of(preset: str, *, on: bool) -> object:
    """The rule of recovery that a preset has for a2s, for a2c with the stabiliser; or ``off``."""
    return choices(preset, "a2s")["recovery"].value if on else "off"
