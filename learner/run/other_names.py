"""What other libraries call our settings, and which are gone, so that who has them is told.

Only what means the same in other libraries is in their tables, though a count may be of one
environment there, and of all of them here. Stable-Baselines3's ``train_freq`` and
``target_entropy`` are not: they are in other units than ``updates_per_step`` and
``entropy_per_action``.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from a2s.protocol.errors import nearest

# Stable-Baselines3, CleanRL, RLPD and Acme, in this order.
_EITHER = {
    "lr": "learning_rate",
    "policy_lr": "learning_rate",
    "actor_lr": "learning_rate",
    "policy_learning_rate": "learning_rate",
    "q_lr": "critic_learning_rate",
    "vf_lr": "critic_learning_rate",
    "critic_lr": "critic_learning_rate",
    "discount": "gamma",
    "norm_obs": "normalise_obs",
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
    "normalize_advantage": "normalise_advantage",
    "norm_adv": "normalise_advantage",
    "target_kl": "kl_stop",
    "max_gradient_norm": "max_grad_norm",
}
OFF_POLICY = _EITHER | {
    "n_critics": "critics",
    "num_qs": "critics",
    "buffer_size": "replay_rows",
    "max_replay_size": "replay_rows",
    "learning_starts": "warm_up_steps",
    "start_training": "warm_up_steps",
    "min_replay_size": "warm_up_steps",
    "batch_size": "batch_rows",
    "gradient_steps": "updates_per_step",
    "utd_ratio": "updates_per_step",
    "n_steps": "n_step",
    "ent_coef": "initial_temperature",
    "alpha": "initial_temperature",
    "init_temperature": "initial_temperature",
    "temp_lr": "temperature_learning_rate",
    "n_quantiles": "quantiles",
    "top_quantiles_to_drop_per_net": "dropped_quantiles",
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


class Removed(NamedTuple):
    """A hyperparameter that is gone: values that do what is done now, and why it went."""

    neutral: tuple[object, ...]
    reason: str


_NOTHING = "it brought nothing; docs/adr/0008"
_UNUSED = "no preset used it"
REMOVED = {
    "on-policy": {
        "critics": Removed((1,), "on-policy there is one"),
        "critic_score": Removed(("mean", "min"), "on-policy there is one critic"),
        "activation": Removed(("tanh",), _UNUSED),
        "q_weight_decay": Removed((0,), _UNUSED),
        "target_lambda": Removed((0.95, 1), "it is gae_lambda"),
        "warm_up_explained_variance": Removed((0,), "warm_up is none or first-fit"),
        "distil_loss": Removed(("mse", "log-likelihood"), "equation 6 is a squared error"),
        "distil_weight": Removed((0.2, 1), "equation 6 has steps of its own"),
        "recovery_best_decay": Removed((0,), _UNUSED),
    },
    "off-policy": {
        "optimism": Removed((0,), _NOTHING),
        "distil_weight": Removed((0,), _NOTHING),
        "distil_top": Removed((1,), _NOTHING),
        "selection_fades": Removed((False,), "off-policy it was not shown to bring anything"),
        "weight_decay": Removed((0,), "every preset had 0"),
    },
}
_REASONS = {name: gone.reason for table in REMOVED.values() for name, gone in table.items()}


def without_removed(
    given: Mapping[str, object], variant: object, valid: Collection[str]
) -> dict[str, object]:
    """What an older version wrote down, without what is gone and changed nothing.

    Args:
        given: Values by name.
        variant: Of the algorithm.
        valid: All names that there are.
    """
    gone = REMOVED.get(str(variant), {})
    return {
        name: value
        for name, value in given.items()
        if name in valid or name not in gone or value not in gone[name].neutral
    }


def meant(name: str, valid: Collection[str], others: Mapping[str, str]) -> str:
    """Say which name is meant by a wrong one.

    Args:
        name: The wrong one.
        valid: All right ones.
        others: Of those, what other libraries call them.

    Returns:
        ``" (here it is 'replay_rows')"``; for a hyperparameter that is none here
        ``" (here it is the option --envs)"``; for one that is gone ``" (removed: ...)"``; else
        what `nearest` says.
    """
    if name in others:
        return f" (here it is {others[name]!r})"
    if name in RUN:
        return f" (here it is the option --{RUN[name].replace('_', '-')})"
    if name in _REASONS:
        return f" (removed: {_REASONS[name]})"
    return nearest(name, valid)
