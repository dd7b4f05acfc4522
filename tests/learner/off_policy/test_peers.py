"""Critics in several processes: to the bit what one process learns."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from a2s.learner.networks.peers import Peers
from a2s.learner.off_policy.config import PRESETS, OffPolicyConfig
from a2s.learner.off_policy.stats import OffPolicyStats
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.protocol.errors import RunDirectoryError

SIZES = ((5, 2), (1, 1))  # of observation and action
ROWS, UPDATES = 32, 4
SMALL: dict[str, Any] = {"policy_sizes": (16, 16), "critic_sizes": (16, 16), "precision": "f32"}
KINDS: dict[str, OffPolicyConfig] = {
    "modern": replace(PRESETS["modern"].config, **SMALL),
    "sac": replace(PRESETS["sac"].config, **SMALL),
    "paper": replace(PRESETS["paper"].config, **SMALL, num_critics=2),
    "four critics, one of which selects, and suggestions that pull": replace(
        PRESETS["modern"].config, **SMALL, num_critics=4, target_suggestions=3, target_groups=2,
        policy_loss="score",
    ),
}  # fmt: skip


class Threads(Peers):
    """Peers in threads of one process, which wait for each other."""

    def __init__(self, number: int, parts: list[Tensor], barrier: threading.Barrier) -> None:
        self._number, self._parts, self._barrier = number, parts, barrier

    def own(self, members: int) -> slice:
        """In the order of threads."""
        each = members // len(self._parts)
        return slice(self._number * each, (self._number + 1) * each)

    def gather(self, own: Tensor) -> Tensor:
        """All parts, once they are there."""
        self._parts[self._number] = own.clone()
        self._barrier.wait()
        found = torch.cat(self._parts)
        self._barrier.wait()
        return found

    def pick(self, own: Tensor, owner: Tensor) -> Tensor:
        """Row by row."""
        every = self.gather(own.unsqueeze(0))
        return torch.stack([every[who, row] for row, who in enumerate(owner.tolist())])


def learn(algorithm: OffPolicy) -> list[OffPolicyStats]:
    """Make some updates, the same in every thread."""
    draws, obs = torch.Generator().manual_seed(7), algorithm.obs_size
    algorithm.observe(torch.randn(40, obs, generator=draws))
    algorithm.observe_returns(10 * torch.randn(40, generator=draws))
    return [
        algorithm.update(
            Transitions(
                obs=torch.randn(ROWS, obs, generator=draws),
                action=torch.rand(ROWS, algorithm.action_size, generator=draws) * 2 - 1,
                reward=torch.randn(ROWS, generator=draws),
                next_obs=torch.randn(ROWS, obs, generator=draws),
                discount=torch.full((ROWS,), 0.99),
                weight=torch.rand(ROWS, generator=draws) + 0.5,
            ),
            learns_policy=number != 1,
        )
        for number in range(UPDATES)
    ]


def in_threads(count: int, work: Callable[[Peers], Any]) -> list[Any]:
    """Do the same in so many threads, each with its peers."""
    parts, barrier = [torch.empty(0)] * count, threading.Barrier(count)

    def one(number: int) -> Any:
        try:
            return work(Threads(number, parts, barrier))
        except BaseException:
            barrier.abort()
            raise

    with ThreadPoolExecutor(count) as threads:
        return list(threads.map(one, range(count)))


@pytest.mark.parametrize("sizes", SIZES, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_two_learn_what_one_learns(kind: str, sizes: tuple[int, int]) -> None:
    """Every number of the state and of what is shown."""
    hyper = KINDS[kind]
    alone = OffPolicy(*sizes, hyper, seed=3)
    shown = learn(alone)

    def work(peers: Peers) -> tuple[list[OffPolicyStats], dict[str, Tensor], Tensor]:
        algorithm = OffPolicy(*sizes, hyper, seed=3, peers=peers)
        stats = learn(algorithm)
        assert algorithm.train_state.critics.members == hyper.num_critics // 2
        assert algorithm.is_finite()
        return stats, algorithm.state(), algorithm.all_critics().value

    for stats, state, critics in in_threads(2, work):
        for found, expected in zip(stats, shown, strict=True):
            for name, value in zip(OffPolicyStats._fields, found, strict=True):
                other = getattr(expected, name)
                assert value is other is None or torch.equal(value, other), name
        for name, tensor in alone.state().items():
            assert torch.equal(state[name], tensor), name
        assert torch.equal(critics, alone.train_state.critics.value)


def test_each_takes_its_part_of_a_state() -> None:
    """One that was saved by one process, or by another number of them."""
    hyper = KINDS["four critics, one of which selects, and suggestions that pull"]
    alone = OffPolicy(*SIZES[0], hyper, seed=3)
    learn(alone)
    saved = alone.state()
    learn(alone)

    def work(peers: Peers) -> dict[str, Tensor]:
        algorithm = OffPolicy(*SIZES[0], hyper, seed=4, peers=peers)
        with pytest.raises(RunDirectoryError, match="critics: found shape"):
            algorithm.load(saved | {"critics": saved["critics"][:-1]})
        algorithm.load(saved)
        learn(algorithm)
        return algorithm.state()

    for state in in_threads(4, work):
        for name, tensor in alone.state().items():
            assert torch.equal(state[name], tensor), name


def test_one_that_is_not_finite_is_noticed_by_all() -> None:
    """Whoever's critic it is."""

    def work(peers: Peers) -> bool:
        algorithm = OffPolicy(*SIZES[0], KINDS["sac"], seed=3, peers=peers)
        if peers.own(2).start == 1:
            algorithm.train_state.critics.value[0] = torch.nan
        return algorithm.is_finite()

    assert in_threads(2, work) == [False, False]
