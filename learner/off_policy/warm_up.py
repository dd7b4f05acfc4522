"""The kernels of an off-policy update, compiled before a run begins (docs/adr/0022)."""

import torch

from a2s.learner.networks import kernels
from a2s.learner.networks.compiled import is_kept
from a2s.learner.off_policy.config import OffPolicyConfig, Precision
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy

_ROWS = 8


def is_compiled() -> bool:
    """Whether they are kept already; else `warm_up` takes about ten seconds, not one."""
    return is_kept(kernels.backward)


def warm_up(precision: Precision) -> None:
    """Make an update of small networks, which nothing else knows of."""
    hyper = OffPolicyConfig(critic_sizes=(8, 8), policy_sizes=(8, 8), precision=precision)
    column = torch.linspace(-1.0, 1.0, _ROWS)
    rows = column.unsqueeze(1)
    one = torch.ones(_ROWS)
    OffPolicy(1, 1, hyper, 0).update(
        Transitions(obs=rows, action=rows, reward=column, next_obs=rows, discount=one, weight=one)
    )
