"""Made-up data of the size of HalfCheetah, for the benchmarks."""

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


def make_segment(seq: int, rng: np.random.Generator) -> Segment:
    """Make a whole episode of 1000 steps."""

    def normal(*shape: int) -> Array:
        return rng.standard_normal(shape, dtype=np.float32)

    return Segment(
        actor="a",
        seq=seq,
        generation=1,
        epoch=0,
        weights_version=0,
        env=0,
        obs=normal(STEPS, OBS),
        suggestion=normal(STEPS, ACTION),
        log_prob=normal(STEPS),
        reward=normal(STEPS),
        final_obs=normal(OBS),
        terminated=False,
        truncated=True,
        episode_return=0.0,
        episode_length=STEPS,
    )
