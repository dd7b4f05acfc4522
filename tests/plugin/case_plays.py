"""Playing an environment within this process."""

import numpy as np

from a2s.actors.environments.environment import Environment
from a2s.actors.metrics import ActorMetrics
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.fields import Array
from a2s.protocol.messages import Notice, Segment

ARRAYS = ("obs", "suggestion", "log_prob", "reward", "final_obs")
SCALARS = ("env", "terminated", "truncated", "episode_return", "episode_length")


def action(*numbers: float) -> Array:
    """An action as the suggester makes it."""
    return np.array(numbers, dtype=np.float32)


def play(
    graph: bytes,
    env_id: str,
    *,
    steps: int = 250,
    episodes: int = 0,
    num_envs: int = 2,
    metrics: ActorMetrics | None = None,
    seed: int = 0,
) -> list[Segment]:
    """Play a quota of steps, and of episodes, in environments with this id."""
    environments = [Environment(EnvConfig(env_id=env_id)) for _ in range(num_envs)]
    rollout = Rollout("tester", environments, seed, metrics or ActorMetrics(), Troubles())
    notice = Notice(
        generation=1, epoch=0, version=1, quota_steps=steps, quota_episodes=episodes, num_bytes=1,
        sha256="",
    )  # fmt: skip
    return list(rollout.play(Suggester(graph), notice, lambda: False))


def are_the_same(one: list[Segment], other: list[Segment]) -> bool:
    """Whether two plays are equal to the bit."""
    return len(one) == len(other) and all(
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)
        and all(getattr(a, name) == getattr(b, name) for name in SCALARS)
        for a, b in zip(one, other, strict=True)
    )
