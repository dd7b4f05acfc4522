"""Other names of our settings, and settings that were removed, for helpful error messages.

The names are those of other libraries, where they mean the same, and our own of earlier versions.
A count may be of one environment there, and of all of them here. Stable-Baselines3's
``train_freq`` and ``target_entropy`` are left out: their units differ from those of ``utd_ratio``
and ``entropy_per_action``.
"""

import math
from collections.abc import Collection, Mapping
from difflib import SequenceMatcher
from types import MappingProxyType
from typing import NamedTuple

from a2s.protocol.errors import nearest

# Stable-Baselines3, CleanRL, RLPD and Acme, in this order.
_EITHER = {
    "lr": "learning_rate",
    "policy_lr": "learning_rate",
    "actor_lr": "learning_rate",
    "policy_learning_rate": "learning_rate",
    "actor_learning_rate": "learning_rate",
    "q_lr": "critic_learning_rate",
    "vf_lr": "critic_learning_rate",
    "critic_lr": "critic_learning_rate",
    "discount": "gamma",
    "normalise_obs": "norm_obs",
    "normalise_return": "norm_return",
}
ON_POLICY = _EITHER | {
    "n_steps": "batch_steps",
    "num_steps": "batch_steps",
    "batch_size": "policy_minibatch",
    "minibatch_size": "policy_minibatch",
    "n_epochs": "policy_epochs",
    "update_epochs": "policy_epochs",
    "num_epochs": "policy_epochs",
    "clip_range": "clip_ratio",
    "clip_coef": "clip_ratio",
    "ppo_clipping_epsilon": "clip_ratio",
    "ent_coef": "entropy_weight",
    "entropy_cost": "entropy_weight",
    "normalize_advantage": "norm_advantage",
    "normalise_advantage": "norm_advantage",
    "norm_adv": "norm_advantage",
    "target_kl": "kl_stop",
    "max_gradient_norm": "max_grad_norm",
    "batch_steps_first": "first_batch_steps",
    "least_minibatches": "min_minibatches",
}
OFF_POLICY = _EITHER | {
    "suggestions": "act_suggestions",
    "n_critics": "num_critics",
    "num_qs": "num_critics",
    "critics": "num_critics",
    "buffer_size": "replay_rows",
    "max_replay_size": "replay_rows",
    "learning_starts": "warm_up_steps",
    "start_training": "warm_up_steps",
    "policy_delay": "policy_every",
    "policy_frequency": "policy_every",
    "min_replay_size": "warm_up_steps",
    "batch_size": "batch_rows",
    "gradient_steps": "utd_ratio",
    "updates_per_step": "utd_ratio",
    "n_steps": "n_step",
    "ent_coef": "initial_temperature",
    "alpha": "initial_temperature",
    "init_temperature": "initial_temperature",
    "temp_lr": "temperature_learning_rate",
    "n_quantiles": "num_quantiles",
    "quantiles": "num_quantiles",
    "top_quantiles_to_drop_per_net": "quantiles_to_drop",
    "dropped_quantiles": "quantiles_to_drop",
    "huber_width": "kappa",
    "importance_sampling_exponent": "importance_exponent",
}
RUN = {
    "total_timesteps": "total_steps",
    "max_steps": "total_steps",
    "n_envs": "envs",
    "num_envs": "envs",
    "env_id": "env",
    "gym_id": "env",
    "env_name": "env",
    "exp_name": "run",
    "num_actors": "n",
}
OPTIONS = (*dict.fromkeys(RUN.values()), "seed", "threads", "device", "preset", "algo", "variant")
_LEAST_LIKELY, _AS_LIKELY, _MOST_NEAR = 0.55, 0.03, 2  # of names to suggest, 1 is the same
_SHORTENED, _ELSEWHERE = 0.75, 0.9


class Removed(NamedTuple):
    """A removed hyperparameter: the values that equal what is done now, and why it was removed."""

    neutral: tuple[object, ...]
    reason: str


_NOTHING = "it brought nothing; docs/adr/0008"
_UNUSED = "no preset used it"
_AUTHORS = "only in the presets authors and paper"
_CONSTANT = "a constant of the presets authors and paper"
REMOVED = {
    "on-policy": {
        "critics": Removed((1,), "on-policy there is one"),
        "critic_score": Removed(("mean", "min"), "on-policy there is one critic"),
        "activation": Removed(("tanh",), _UNUSED),
        "q_weight_decay": Removed((0,), _UNUSED),
        "target_lambda": Removed((0.95, 1), "it is gae_lambda"),
        "warm_up_explained_variance": Removed((0,), "Q chooses after its first fit"),
        "warm_up": Removed(("first-fit",), "Q chooses after its first fit"),
        "action_mode": Removed(("clip",), "Q sees suggestions clipped to the bounds"),
        "min_episodes": Removed((0,), _AUTHORS),
        "whole_episodes": Removed((False,), _CONSTANT),
        "time_limit_is_terminal": Removed((False,), _CONSTANT),
        "init": Removed(("orthogonal",), "uniform weights are " + _CONSTANT),
        "learn_std": Removed((True,), "a fixed deviation is " + _CONSTANT),
        "fit_rule": Removed(("epochs",), "the threshold is " + _CONSTANT),
        "fit_steps": Removed((100,), _CONSTANT),
        "q_fit_extra_steps": Removed((0,), _CONSTANT),
        "value_fit_extra_steps": Removed((0,), _CONSTANT),
        "fit_threshold": Removed((0,), _CONSTANT),
        "advantage": Removed(("gae",), _AUTHORS + "; with gae_lambda 1 GAE is the return less V"),
        "policy_loss": Removed(("clip",), "with policy_epochs 1, policy_minibatch 0 it is score"),
        "distil_top": Removed((1,), _UNUSED),
        "recovery_offset": Removed((0,), _AUTHORS),
        "recovery_restores": Removed(("everything",), "only networks is " + _CONSTANT),
        "recovery_learns": Removed((False,), _AUTHORS),
        "recovery_kl_divisor": Removed((1,), _CONSTANT),
        "critic_follows_rule": Removed((False,), _CONSTANT),
        "lr_min": Removed((), "it is a fiftieth of learning_rate"),
        "lr_max": Removed((), "it is 6 times learning_rate"),
        "kl_scope": Removed(("update",), "after equation 6 alone is " + _CONSTANT),
        "kl_dims": Removed(("joint",), "their mean is " + _CONSTANT),
        "distil_loss": Removed(("mse", "log-likelihood"), "equation 6 is a squared error"),
        "distil_weight": Removed((0.2, 1), "equation 6 has steps of its own"),
        "recovery_best_decay": Removed((0,), _UNUSED),
        "selection": Removed(("soft",), "actors choose softly; docs/adr/0021"),
        "temperature": Removed((), "it is act_least_share; docs/adr/0021"),
        "selection_temperature": Removed((), "it is act_least_share; docs/adr/0021"),
        "selection_fades": Removed((), "actors choose as far as Q is right; docs/adr/0021"),
        "anneal_selection": Removed((), "actors choose as far as Q is right; docs/adr/0021"),
        "distil": Removed((), "equation 6 is pull; docs/adr/0021"),
        "distil_suggestions": Removed((), "it is suggestions; docs/adr/0021"),
        "distil_steps": Removed((), "equation 6 is pull; docs/adr/0021"),
        "distil_minibatch": Removed((), "equation 6 is pull; docs/adr/0021"),
        "distil_kl": Removed((), "equation 6 is pull; docs/adr/0021"),
    },
    "off-policy": {
        "optimism": Removed((0,), _NOTHING),
        "distil_weight": Removed((0,), _NOTHING),
        "distil_top": Removed((1,), _NOTHING),
        "selection_fades": Removed((False,), "off-policy it was not shown to bring anything"),
        "selector": Removed(("one",), "one critic, drawn anew, selects"),
        "quiet_rare_obs": Removed((True,), "it is a part of norm_obs; docs/adr/0016"),
        "distil_suggestions": Removed((10,), "the loss score has act_suggestions"),
        "weight_decay": Removed((0,), "every preset had 0"),
    },
}
# Former settings of the presets authors and paper: now constants, or unused as before.
_OF_AUTHORS: dict[str, object] = {
    "action_mode": "raw", "anneal_selection": False, "batch_growth": 1, "clip_ratio": 0.2,
    "critic_epochs": 10, "critic_follows_rule": True, "critic_learning_rate": 1e-3,
    "critic_minibatch": 128, "distil_kl": math.inf, "distil_minibatch": 128, "distil_steps": 50,
    "distil_suggestions": 10, "distil_top": 1, "entropy_weight": 0, "fit_rule": "threshold",
    "fit_steps": 100, "fit_threshold": 100, "gae_lambda": 1, "init": "uniform",
    "kl_dims": "mean", "kl_scope": "policy-gradient", "kl_stop": math.inf, "layer_norm": True,
    "learn_std": False, "lr_max": math.inf, "lr_min": 0, "lr_rule": "kl", "max_grad_norm": 0,
    "max_policy_lag": 0, "min_minibatches": 1, "norm_advantage": False, "norm_obs": False,
    "norm_return": False, "policy_epochs": 1, "policy_loss": "score", "policy_minibatch": 0,
    "q_fit_extra_steps": 5000, "recovery_cool_down": 0, "recovery_episodes": 0,
    "recovery_kl_divisor": 1.1, "recovery_lr_divisor": 5, "recovery_restores": "networks",
    "return_window_steps": 20480, "selection": "hard", "selection_temperature": 1,
    "std_floor": 0.3, "time_limit_is_terminal": True, "value_fit_extra_steps": 100,
    "warm_up": "none", "weight_limit": 0, "whole_episodes": True,
}  # fmt: skip
_TABLES = REMOVED | {
    "authors": REMOVED["on-policy"]
    | {name: Removed((value,), _CONSTANT) for name, value in _OF_AUTHORS.items()}
    | {"first_batch_steps": Removed((500, 1), _CONSTANT)},
}


# What runs did before there was a hyperparameter, where its default is something else.
ADDED: dict[str, dict[str, object]] = {"off-policy": {"policy_every": 1, "short_steps": 0}}


def with_added(
    given: Mapping[str, object], variant: str, valid: Collection[str]
) -> dict[str, object]:
    """Add the later hyperparameters that a file lacks which states all others: so was its run.

    The arguments are those of `without_removed`.
    """
    added, missing = ADDED.get(variant, {}), set(valid) - given.keys()
    if not missing <= added.keys():
        return {**given}
    return {**given, **{name: added[name] for name in missing}}


def without_removed(
    given: Mapping[str, object], variant: str, valid: Collection[str]
) -> dict[str, object]:
    """Leave out removed hyperparameters whose value changed nothing.

    ``variant`` is ``on-policy``, ``off-policy``, or ``authors`` for the presets authors and paper;
    ``valid`` are all its names.
    """
    gone = _TABLES[variant]
    return {
        name: value
        for name, value in given.items()
        if name in valid or name not in gone or value not in gone[name].neutral
    }


def meant(
    name: str,
    valid: Collection[str],
    variant: str = "on-policy",
    elsewhere: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Say which valid name is meant by an unknown one.

    ``elsewhere`` says of names that are not valid here where they are.

    Returns:
        ``" (here it is 'replay_rows')"``; ``" (here it is the option --envs)"``;
        ``" (only with --variant off-policy: 'utd_ratio')"``; ``" (removed: ...)"``;
        ``" (did you mean 'gamma'?)"``, of all these names; else the valid ones.
    """
    ours, others = (OFF_POLICY, ON_POLICY) if variant == "off-policy" else (ON_POLICY, OFF_POLICY)
    target = ours.get(name, name)
    if target in valid:
        return f" (here it is {target!r})"
    if name in RUN or name in OPTIONS:
        return f" (here it is the option {_option(RUN.get(name, name))})"
    if name in REMOVED[variant]:
        reason = REMOVED[variant][name].reason
        return f" ({reason})" if reason.startswith(_AUTHORS) else f" (removed: {reason})"
    for each in (target, others.get(name, name)):
        if each in elsewhere:
            return f" (only {elsewhere[each]}{'' if each == name else f': {each!r}'})"
    rest = [each for each in (*elsewhere, *OPTIONS) if each not in valid]
    found = dict.fromkeys(ours.get(near, near) for near in _near(name, valid, rest))
    known = ", or ".join(_shown(near, valid, elsewhere) for near in found)
    return f" (did you mean {known}?)" if known else f" (valid: {', '.join(sorted(valid))})"


def _near(name: str, valid: Collection[str], others: Collection[str]) -> list[str]:
    """Names like a mistyped or shortened one, the likeliest first; ``others`` are less likely."""
    parts = set(name.split("_"))

    def likeness(other: str) -> float:
        typed = SequenceMatcher(None, other, name).ratio()
        likely = max(typed, _SHORTENED) if parts <= set(other.split("_")) else typed
        return likely if other in valid else likely * _ELSEWHERE

    likely = sorted(((likeness(other), other) for other in (*valid, *others)), reverse=True)
    least = max(_LEAST_LIKELY, likely[0][0] - _AS_LIKELY)
    return [other for likeness, other in likely[:_MOST_NEAR] if likeness >= least]


def _shown(name: str, valid: Collection[str], elsewhere: Mapping[str, str]) -> str:
    if name in valid:
        return repr(name)
    if name in elsewhere:
        return f"{name!r}, only {elsewhere[name]}"
    return f"the option {_option(name)}"


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def option_meant(name: str, valid: Collection[str]) -> str:
    """Say which option of a run is meant by an unknown one."""
    return f" (here it is {RUN[name]!r})" if name in RUN else nearest(name, valid)
