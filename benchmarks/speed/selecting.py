"""Choosing an action: ``python -m speed.selecting CONTENDER K:B SECONDS`` prints observations/s.

K suggestions for each of B observations of the size of HalfCheetah's, by the default networks, one
thread. Noise is drawn, since an actor draws it.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
import torch

CONTENDERS = ("a2s", "torch")


def ours(suggestions: int, count: int) -> Callable[[], object]:
    """As an actor: the published graph."""
    from a2s.actors.suggester import Suggester
    from a2s.commands.bench_actor import graph
    from a2s.commands.bench_data import SPACES

    suggester, rng = Suggester(graph(SPACES, suggestions)), np.random.default_rng(0)
    obs = rng.standard_normal((count, SPACES.obs_size), dtype=np.float32)
    return lambda: suggester(obs, rng)


def eager(suggestions: int, count: int) -> Callable[[], object]:
    """The same by torch, an operation after the other, without gradients."""
    from a2s.commands.bench_data import ACTION, OBS
    from a2s.learner.on_policy.config import OnPolicyConfig
    from a2s.learner.on_policy.update import OnPolicy

    algorithm = OnPolicy(OBS, ACTION, OnPolicyConfig(suggestions=suggestions), 0)
    algorithm.q_trusted = True
    suggester = algorithm.suggester(-torch.ones(ACTION), torch.ones(ACTION))
    obs = torch.randn(count, OBS)

    def choose() -> object:
        normal = torch.randn(count, suggestions, ACTION)
        gumbel = -torch.log(torch.empty(count, suggestions).exponential_())
        return suggester(obs, normal, gumbel)

    return choose


def main() -> None:
    """Measure one."""
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    name, work, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    suggestions, count = map(int, work.split(":"))
    choose = (ours if name == "a2s" else eager)(suggestions, count)
    for _ in range(20):
        choose()
    calls, begin_s = 0, time.perf_counter()
    while (spent_s := time.perf_counter() - begin_s) < seconds:
        choose()
        calls += 1
    sys.stdout.write(f"{calls * count / spent_s}\n")


if __name__ == "__main__":
    main()
