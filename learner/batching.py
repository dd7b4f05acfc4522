"""Segments to a batch: the one place where what came over the wire becomes tensors."""

from collections.abc import Sequence

import numpy as np
import torch

from a2s.learner.algorithm.batch import Batch
from a2s.protocol.messages import Segment


def to_batch(segments: Sequence[Segment]) -> Batch:
    """Put segments one after the other.

    Args:
        segments: At least one, in the order in which their steps are to stand.
    """
    return Batch(
        obs=torch.from_numpy(np.concatenate([s.obs for s in segments])),
        suggestion=torch.from_numpy(np.concatenate([s.suggestion for s in segments])),
        log_prob=torch.from_numpy(np.concatenate([s.log_prob for s in segments])),
        reward=torch.from_numpy(np.concatenate([s.reward for s in segments])),
        lengths=torch.tensor([s.num_steps for s in segments]),
        weights_version=torch.tensor([s.weights_version for s in segments]),
        final_obs=torch.from_numpy(np.stack([s.final_obs for s in segments])),
        terminated=torch.tensor([s.terminated for s in segments]),
        truncated=torch.tensor([s.truncated for s in segments]),
        episode_returns=torch.tensor(
            [s.episode_return for s in segments if s.ends_episode], dtype=torch.float32
        ),
    )
