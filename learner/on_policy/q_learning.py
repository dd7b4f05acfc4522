"""What Q learns: V-trace on the window of latest batches, under the present policy."""

from typing import NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.compiled import outputs
from a2s.learner.networks.gaussian import log_density
from a2s.learner.on_policy import categorical
from a2s.learner.on_policy.acting import as_q_sees
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.returns import bootstrap, v_trace
from a2s.learner.on_policy.state import TrainState

OUTPUT_STD = 3.0  # of Q's outputs: their range is four deviations of the returns to either side


class QTargets(NamedTuple):
    """Inputs of Q for every step of the window, and what it is to answer."""

    inputs: Tensor  # [N, D + A]
    target: Tensor  # in returns, [N]


@torch.no_grad()
def q_targets(window: Batch, state: TrainState, *, gamma: float, lam: float) -> QTargets:
    """Estimate what each executed action of the window is worth under the present policy.

    Q has no part in its own targets, V does: an error of Q dies with the targets that it was
    fitted to, and nothing has to be asked of Q for the whole window (docs/adr/0023).
    """
    steps = window.num_steps
    norm_obs = state.normaliser(torch.cat([window.obs, window.final_obs]))
    said, mean = outputs((state.value_net, norm_obs), (state.policy.network, norm_obs[:steps]))
    value = state.returns.restore(said.squeeze(1))
    log_std = state.policy.log_std
    apart = (window.suggestion - mean) * (-log_std).exp()
    target = v_trace(
        window,
        value[:steps],
        bootstrap(window, value[steps:], time_limit_is_terminal=False),
        (log_density(apart, log_std) - window.log_prob).exp(),
        gamma=gamma,
        lam=lam,
    )
    return QTargets(torch.cat([norm_obs[:steps], as_q_sees(window.suggestion, "clip")], 1), target)


class Opinion(NamedTuple):
    """What Q says of executed actions, in returns, ``[N]`` each."""

    value: Tensor
    over_mean: Tensor  # by how much it finds them better than the mean action


def opinion(state: TrainState, norm_obs: Tensor, action: Tensor) -> Opinion:
    """Ask Q about observations ``[N, D]`` and suggestions ``[N, A]``."""
    both = as_q_sees(torch.stack([action, state.policy(norm_obs)], 1), "clip")
    executed, mean = categorical.score(state.q_net, norm_obs, both).unbind(1)
    difference = (executed - mean) * (state.returns.std / OUTPUT_STD)
    return Opinion(state.returns.restore(executed / OUTPUT_STD), difference)


def in_outputs(state: TrainState, returns: Tensor) -> Tensor:
    """Returns to outputs of Q."""
    return state.returns.normalise(returns) * OUTPUT_STD
