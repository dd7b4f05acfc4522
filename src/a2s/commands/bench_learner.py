"""One off-policy update beside those of Stable-Baselines3 and sbx, all from rows of a buffer.

Batches of 256, hidden layers 256-256, one thread of torch unless a name says two; JAX is not
limited. Each contender has its own process, because the release of memory and the number of
threads are settings of a whole process.
"""

import importlib
import importlib.util
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from typing import Any

import numpy as np
import torch

from a2s.commands.bench import Contender, Contest, missing
from a2s.commands.bench_data import ACTION, BATCH, ENV_ID, OBS
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run.config import off_policy
from a2s.learner.run.memory import keep_freed_memory
from a2s.protocol.errors import A2SError

STORED = 20_000
UPDATES = 10

_FASTEST = off_policy("sac", {}).precision  # bf16 without its instructions takes 25 times as long
_TWO = "two threads"
_OURS: dict[str, tuple[str, dict[str, object]]] = {
    "a2s sac, f32": ("sac", {"precision": "f32"}),
    f"a2s sac, {_FASTEST}": ("sac", {}),
    f"a2s sac, {_FASTEST}, K_target 4": ("sac", {"target_suggestions": 4}),
    f"a2s sac, {_FASTEST}, no LayerNorm": ("sac", {"layer_norm": False}),
    "a2s modern, f32": ("modern", {"precision": "f32"}),
    f"a2s modern, {_FASTEST}": ("modern", {}),
    f"a2s modern, {_FASTEST}, policy_every 1": ("modern", {"policy_every": 1}),
    f"a2s sac, {_FASTEST}, {_TWO}": ("sac", {}),
}
_prepared: list[Callable[[], None]] = []  # in the process of a contender: its ten updates
_THEIRS = {"stable_baselines3": ("stable-baselines3", True), "sbx": ("sbx-rl", False)}


def contests(stack: ExitStack) -> list[Contest]:
    """Start the processes; all of them get ready at once."""
    started = [_start(name, name, stack) for name in _OURS]
    for module, (package, is_baseline) in _THEIRS.items():
        if importlib.util.find_spec(module) is None:
            missing(package)
        else:
            started.append(_start(f"{package} SAC", module, stack, is_baseline=is_baseline))
    return [Contest("updates/s", started)]


def _start(name: str, which: str, stack: ExitStack, *, is_baseline: bool = False) -> Contender:
    spawn = multiprocessing.get_context("spawn")
    process = stack.enter_context(ProcessPoolExecutor(1, spawn, _prepare, (which,)))
    process.submit(_update)

    def update() -> None:
        try:
            process.submit(_update).result()
        except BrokenProcessPool:
            raise A2SError(f"bench learner: the process of {name} ended; see above why") from None

    return Contender(name, update, UPDATES, is_baseline)


def _prepare(which: str) -> None:
    torch.set_num_threads(2 if which.endswith(_TWO) else 1)
    _prepared.append(_ours(*_OURS[which]) if which in _OURS else _theirs(which))


def _update() -> None:
    _prepared[0]()


def _ours(preset: str, options: dict[str, object]) -> Callable[[], None]:
    keep_freed_memory()
    algorithm = OffPolicy(OBS, ACTION, off_policy(preset, options), 0)
    stored = Transitions(
        obs=torch.randn(STORED, OBS),
        action=2.0 * torch.rand(STORED, ACTION) - 1.0,
        reward=torch.randn(STORED),
        next_obs=torch.randn(STORED, OBS),
        discount=torch.full((STORED,), 0.99),
        weight=torch.ones(STORED),
    )
    algorithm.observe(stored.obs)

    def update() -> None:
        for number in range(UPDATES):
            rows = torch.randint(STORED, (BATCH,))
            algorithm.update(
                Transitions(*(each[rows] for each in stored)),
                learns_policy=number % algorithm.hyper.policy_every == 0,
            )

    return update


def _theirs(module: str) -> Callable[[], None]:
    model: Any = importlib.import_module(module).SAC(
        "MlpPolicy", ENV_ID, buffer_size=STORED, learning_starts=0
    )
    model._setup_learn(1, None)
    rng = np.random.default_rng(0)
    for _ in range(STORED):
        obs, new = rng.standard_normal((2, 1, OBS)).astype(np.float32)
        action = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32)
        model.replay_buffer.add(obs, new, action, rng.standard_normal(1), np.zeros(1), [{}])

    def update() -> None:
        model.train(gradient_steps=UPDATES, batch_size=BATCH)

    return update
