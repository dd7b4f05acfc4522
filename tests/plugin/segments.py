"""Segments for tests: ordinary numbers of any size, the same for the same number."""

from typing import Any

import numpy as np

from a2s.protocol.messages import Segment


def segment(
    seq: int = 0, steps: int = 4, *, obs_size: int = 2, action_size: int = 1, **fields: Any
) -> Segment:
    """Steps of actor ``a`` from the beginning of an episode, which goes on; fields as given."""
    rng = np.random.default_rng(seq)
    values: dict[str, Any] = {
        "actor": "a", "generation": 1, "epoch": 0, "weights_version": 1, "env": 0,
        "suggestion": rng.uniform(-1, 1, (steps, action_size)).astype(np.float32),
        "obs": rng.standard_normal((steps, obs_size)).astype(np.float32),
        "log_prob": np.zeros(steps, np.float32), "reward": np.ones(steps, np.float32),
        "final_obs": np.zeros(obs_size, np.float32), "terminated": False, "truncated": False,
        "episode_return": 1.0, "episode_length": steps,
    }  # fmt: skip
    return Segment(seq=seq, **{**values, **fields})
