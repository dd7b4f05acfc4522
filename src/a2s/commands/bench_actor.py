"""Acting in one process: environments, suggestions and segments, beside bare environments."""

from contextlib import ExitStack

import numpy as np
import torch

from a2s.actors.environments.environment import Environment
from a2s.actors.metrics import ActorMetrics
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.commands.bench import Contender, Contest
from a2s.learner.export.on_policy import export
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.update import OnPolicy
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Notice

ENV_IDS = ("Hopper-v5", "HalfCheetah-v5")
ENVS, STEPS = 16, 32


def contests(stack: ExitStack) -> list[Contest]:
    """Make the environments, and graphs of the default networks with their first weights."""
    del stack
    torch.set_num_threads(1)
    return [
        Contest("env steps/s", [_acting(env_id, 10), _acting(env_id, 1), _bare(env_id)])
        for env_id in ENV_IDS
    ]


def _acting(env_id: str, suggestions: int) -> Contender:
    environments = [Environment(EnvConfig(env_id=env_id), fast=True) for _ in range(ENVS)]
    suggester = Suggester(graph(environments[0].spaces, suggestions))
    rollout = Rollout("bench", environments, 0, ActorMetrics(), Troubles())
    notice = Notice(
        generation=1, epoch=0, version=1, quota_steps=STEPS, quota_episodes=0, num_bytes=1,
        sha256="",
    )  # fmt: skip
    return Contender(
        f"{env_id}: a2s, K {suggestions}",
        lambda: list(rollout.play(suggester, notice, lambda: False)),
        ENVS * STEPS,
    )


def graph(spaces: Spaces, suggestions: int) -> bytes:
    """Default networks with their first weights, as actors get them."""
    config = OnPolicyConfig(suggestions=suggestions)
    algorithm = OnPolicy(spaces.obs_size, len(spaces.action_low), config, 0)
    algorithm.q_trusted = True
    bounds = torch.from_numpy(spaces.action_low), torch.from_numpy(spaces.action_high)
    return export(algorithm.suggester(*bounds), 1, {})


def _bare(env_id: str) -> Contender:
    """Step with random actions that were drawn before, and reset; nothing is recorded."""
    environment = Environment(EnvConfig(env_id=env_id))
    spaces, rng = environment.spaces, np.random.default_rng(0)
    size = (STEPS, len(spaces.action_low))
    actions = rng.uniform(spaces.action_low, spaces.action_high, size).astype(np.float32)
    environment.reset(0)

    def step() -> None:
        for action in actions:
            _, _, terminated, truncated = environment.step(action)
            if terminated or truncated:
                environment.reset()

    return Contender(f"{env_id}: random actions", step, STEPS, is_baseline=True)
