"""What an update calls is compiled when it is called first, and kept: once for a machine.

Done before a run begins, it can be announced (docs/adr/0022).
"""

import torch

from a2s.learner.networks.compiled import is_kept
from a2s.learner.on_policy import fit_kernels
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.update import OnPolicy

_STEPS, _UPDATES = 8, 2  # the second asks Q about the batch, too


def is_compiled() -> bool:
    """Whether it is kept already; else `warm_up` takes tens of seconds, not one."""
    return is_kept(fit_kernels.policy_pass)


def warm_up() -> None:
    """Make two updates of small networks, which nothing else knows of."""
    algorithm = OnPolicy(1, 1, OnPolicyConfig(q_steps=1, policy_epochs=1, critic_epochs=1), 0)
    column = torch.linspace(-1.0, 1.0, _STEPS)
    for _ in range(_UPDATES):
        algorithm.update(
            Batch(
                obs=column.unsqueeze(1),
                suggestion=column.unsqueeze(1),
                log_prob=torch.full((_STEPS,), -1.0),
                reward=column,
                lengths=torch.tensor([_STEPS]),
                weights_version=torch.tensor([0]),
                final_obs=torch.ones(1, 1),
                terminated=torch.tensor([False]),
                truncated=torch.tensor([True]),
                episode_returns=torch.tensor([0.0]),
            )
        )
