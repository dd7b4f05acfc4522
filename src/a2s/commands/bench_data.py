"""Made-up data of the size of HalfCheetah, for the benchmarks."""

from typing import Any

import numpy as np

from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import Segment

ENV_ID = "HalfCheetah-v5"
OBS, ACTION, STEPS, BATCH = 17, 6, 1000, 256
SPACES = Spaces(
    obs_size=OBS,
    action_low=-np.ones(ACTION, np.float32),
    action_high=np.ones(ACTION, np.float32),
)


def make_segment(
    rng: np.random.Generator, *, steps: int = STEPS, spaces: Spaces = SPACES, **of: Any
) -> Segment:
    """Make the last steps of an episode, of actions within -1 and 1; ``of`` are other fields."""

    def normal(*shape: int) -> Array:
        return rng.standard_normal(shape, dtype=np.float32)

    fields: dict[str, Any] = {
        "actor": "a", "seq": 0, "generation": 1, "epoch": 0, "weights_version": 0, "env": 0,
        "terminated": False, "truncated": True, "episode_return": 0.0, "episode_length": steps,
    }  # fmt: skip
    return Segment(
        obs=normal(steps, spaces.obs_size),
        suggestion=rng.uniform(-1, 1, (steps, spaces.action_size)).astype(np.float32),
        log_prob=normal(steps),
        reward=normal(steps),
        final_obs=normal(spaces.obs_size),
        **{**fields, **of},
    )
