"""Small on-policy learners, and batches that they play without an environment."""

import dataclasses
from typing import Any

import torch

from a2s.learner.on_policy.authors import Authors
from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.presets import PRESETS
from a2s.learner.on_policy.stats import UpdateStats
from a2s.learner.on_policy.update import OnPolicy

D, A = 4, 2
SIZES = {"policy_sizes": (16,), "value_sizes": (16,), "q_sizes": (16,)}
BOUNDS = -torch.ones(A), torch.ones(A)


def make(seed: int = 7, **options: Any) -> OnPolicy:
    """Build a small learner."""
    values = SIZES | {"critic_epochs": 2, "critic_minibatch": 32} | options
    return OnPolicy(D, A, OnPolicyConfig(**values), seed)


def make_preset(preset: str, seed: int = 7, **options: Any) -> OnPolicy | Authors:
    """Build a small learner of any preset."""
    config = PRESETS[preset].config
    if isinstance(config, OnPolicyConfig):
        return make(seed, **options)
    return Authors(D, A, dataclasses.replace(config, **(SIZES | options)), seed)


def make_a2c(preset: str = "modern") -> OnPolicy | Authors:
    """Build the small A2C of any preset."""
    config = make_preset(preset).config.as_a2c()
    if isinstance(config, OnPolicyConfig):
        return OnPolicy(D, A, config, 7)
    return Authors(D, A, config, 7)


def play(
    algorithm: OnPolicy | Authors,
    seed: int,
    score: float = 10.0,
    version: int = 0,
    unit: float | None = None,
) -> Batch:
    """A batch of four segments whose reward is the larger the nearer the action is to .5.

    With a ``unit`` of observations: to half the sign of the first of them.
    """
    generator = torch.Generator().manual_seed(seed)
    size = 1.0 if unit is None else unit
    obs = size * torch.randn(80, D, generator=generator)
    suggester = algorithm.suggester(*BOUNDS)
    normal = torch.randn(80, suggester.suggestions, A, generator=generator)
    gumbel = torch.randn(80, suggester.suggestions, generator=generator)
    with torch.no_grad():
        choice = suggester(obs, normal, gumbel)
    wanted = 0.5 if unit is None else 0.5 * obs[:, :1].sign()
    return Batch(
        obs=obs,
        suggestion=choice.suggestion,
        log_prob=choice.log_prob,
        reward=-(choice.action - wanted).square().sum(1),
        lengths=torch.tensor([30, 10, 20, 20]),
        weights_version=torch.full((4,), version),
        final_obs=size * torch.randn(4, D, generator=generator),
        terminated=torch.tensor([True, False, False, True]),
        truncated=torch.tensor([False, True, False, False]),
        episode_returns=torch.full((3,), score),
    )


def fingerprint(
    algorithm: OnPolicy | Authors, *, without: str | tuple[str, ...] = "-"
) -> dict[str, list[float]]:
    """Write out every tensor of the state, but those of some prefixes."""
    tensors, _ = algorithm.state()
    return {
        name: tensor.flatten().tolist()
        for name, tensor in tensors.items()
        if not name.startswith(without)
    }


def batch_of(reward: torch.Tensor, lengths: list[int], terminated: list[bool], *cut: bool) -> Batch:
    """A batch of which only rewards and segments matter; ``cut``: truncated, of each segment."""
    steps, segments = len(reward), len(lengths)
    return Batch(
        obs=torch.zeros(steps, 3),
        suggestion=torch.zeros(steps, 2),
        log_prob=torch.zeros(steps),
        reward=reward,
        lengths=torch.tensor(lengths),
        weights_version=torch.zeros(segments, dtype=torch.int64),
        final_obs=torch.zeros(segments, 3),
        terminated=torch.tensor(terminated),
        truncated=torch.tensor(cut or [False] * segments),
        episode_returns=torch.zeros(0),
    )


def crash(algorithm: OnPolicy | Authors) -> tuple[dict[str, list[float]], UpdateStats]:
    """A good batch made by version 4, some learning, then a crash that must recover."""
    best = fingerprint(algorithm)
    algorithm.update(play(algorithm, 0, 100.0, version=4))
    algorithm.update(play(algorithm, 1, 99.0, version=5))
    for number in range(2, 40):
        stats = algorithm.update(play(algorithm, number, -1000.0, version=number + 4))
        if stats.recovered:
            return best, stats
    raise AssertionError("never recovered")


def mean_action(algorithm: OnPolicy | Authors, obs: torch.Tensor) -> torch.Tensor:
    """Of the policy, ``[N, A]``."""
    with torch.no_grad():
        mean: torch.Tensor = algorithm.policy(algorithm.normaliser(obs))
    return mean
