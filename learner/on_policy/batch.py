"""What one update learns from."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class BatchSize(NamedTuple):
    """What a batch holds at least: steps, and whole episodes; 0 episodes: they may be cut."""

    steps: int
    episodes: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Segments of several environments, one after the other: N rows, S segments.

    Raises:
        ValueError: The tensors disagree, or there is no step.
    """

    obs: Tensor  # before each step, float32 [N, D]
    suggestion: Tensor  # executed, canonical, before clipping, float32 [N, A]
    log_prob: Tensor  # their log density as executed, selection included, float32 [N]
    reward: Tensor  # undiscounted, float32 [N]
    lengths: Tensor  # steps of each segment, in the order of the rows, int64 [S]
    weights_version: Tensor  # that made each segment, int64 [S]
    final_obs: Tensor  # after the last step of each segment, float32 [S, D]
    terminated: Tensor  # that step reached a terminal state, bool [S]
    truncated: Tensor  # that step hit a time limit, bool [S]; neither: the episode goes on
    episode_returns: Tensor  # undiscounted, of the E episodes that ended here, float32 [E]

    def __post_init__(self) -> None:
        """Check the shapes against each other."""
        steps, segments, obs_size = len(self.reward), len(self.lengths), self.obs.shape[-1]
        expected: dict[str, tuple[int, ...]] = {
            "obs": (steps, obs_size),
            "suggestion": (steps, self.suggestion.shape[-1]),
            "log_prob": (steps,),
            "reward": (steps,),
            "weights_version": (segments,),
            "final_obs": (segments, obs_size),
            "terminated": (segments,),
            "truncated": (segments,),
            "episode_returns": (len(self.episode_returns),),
        }
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"batch: {name}: found shape {found}, expected {shape}")
        if steps == 0 or int(self.lengths.sum()) != steps or int(self.lengths.min()) < 1:
            lengths = self.lengths.tolist()
            raise ValueError(f"batch: lengths: found {lengths}, expected a sum of {steps} steps")

    @property
    def num_steps(self) -> int:
        """N."""
        return len(self.reward)

    @property
    def last(self) -> Tensor:
        """Row of the last step of each segment, int64 ``[S]``."""
        return torch.cumsum(self.lengths, 0) - 1
