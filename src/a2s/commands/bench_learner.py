"""One off-policy update beside those of Stable-Baselines3 and sbx, all from rows of a buffer.

Batches of 256, hidden layers 256-256, one thread of torch; JAX takes what it wants.
"""

from contextlib import ExitStack
from typing import Any

import numpy as np
import torch

from a2s.commands.bench import Contender, Contest, optional
from a2s.commands.bench_data import ACTION, BATCH, OBS
from a2s.learner.algorithm.off_policy import OffPolicy
from a2s.learner.algorithm.transitions import Transitions
from a2s.learner.memory import keep_freed_memory
from a2s.learner.off_policy_presets import off_policy

ENV_ID = "HalfCheetah-v5"  # of these sizes; it is never stepped
STORED = 20_000
UPDATES = 10

_OURS: dict[str, tuple[str, dict[str, object]]] = {
    "a2s sac, f32": ("sac", {"precision": "f32"}),
    "a2s sac, bf16": ("sac", {"precision": "bf16"}),
    "a2s sac, bf16, K_target 4": ("sac", {"precision": "bf16", "target_suggestions": 4}),
    "a2s sac, bf16, no LayerNorm": ("sac", {"precision": "bf16", "layer_norm": False}),
    "a2s modern, bf16": ("modern", {"precision": "bf16"}),
}
_THEIRS = {"stable_baselines3": ("stable-baselines3", True), "sbx": ("sbx-rl", False)}


def contests(stack: ExitStack) -> list[Contest]:
    """Make an algorithm of each kind, with rows to learn from."""
    del stack
    torch.set_num_threads(1)
    keep_freed_memory()
    contenders = [_ours(name, *how) for name, how in _OURS.items()]
    for module, (package, is_baseline) in _THEIRS.items():
        library = optional(module, package)
        if library is not None:
            contenders.append(_theirs(library, package, is_baseline=is_baseline))
    return [Contest("updates/s", contenders)]


def _ours(name: str, preset: str, options: dict[str, object]) -> Contender:
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
        for _ in range(UPDATES):
            rows = torch.randint(STORED, (BATCH,))
            algorithm.update(Transitions(*(each[rows] for each in stored)))

    return Contender(name, update, UPDATES)


def _theirs(library: Any, name: str, *, is_baseline: bool) -> Contender:
    model = library.SAC("MlpPolicy", ENV_ID, buffer_size=STORED, learning_starts=0)
    model._setup_learn(1, None)
    rng = np.random.default_rng(0)
    for _ in range(STORED):
        obs, new = rng.standard_normal((2, 1, OBS)).astype(np.float32)
        action = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32)
        model.replay_buffer.add(obs, new, action, rng.standard_normal(1), np.zeros(1), [{}])

    def update() -> None:
        model.train(gradient_steps=UPDATES, batch_size=BATCH)

    return Contender(f"{name} SAC", update, UPDATES, is_baseline)
