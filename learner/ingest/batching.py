"""Arrays to tensors: segments to a batch, rows of a replay to transitions."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch

from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.on_policy.batch import Batch
from a2s.learner.replay import sampling as stored
from a2s.protocol.messages import Segment
from a2s.protocol.replay_messages import MOST_STEPS

_RETURNS_EVERY_UPDATES = 20


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


class Source(Protocol):
    """A replay to draw from: one's own, the files of another run, or what its learner serves."""

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        *,
        n_step: int = 1,
        gamma: float = 0.99,
        prioritised: bool = False,
        beta: float = 0.4,
    ) -> stored.Transitions:
        """Draw transitions."""
        ...


def wants_returns(hyper: OffPolicyHyper, updates: int) -> bool:
    """Whether returns are to be drawn before the next update, after so many."""
    return hyper.normalise_return and updates % _RETURNS_EVERY_UPDATES == 0


def draw_returns(source: Source, hyper: OffPolicyHyper, rng: np.random.Generator) -> torch.Tensor:
    """Draw discounted returns, over as many steps as any source adds up: float32 ``[B]``.

    Raises:
        A2SError: The source refuses, or is gone.
    """
    drawn = source.sample(hyper.batch_rows, rng, n_step=MOST_STEPS, gamma=hyper.gamma)
    return torch.from_numpy(drawn.reward)


def draw(
    source: Source, hyper: OffPolicyHyper, rng: np.random.Generator
) -> tuple[Transitions, stored.Rows]:
    """Draw the batch of an update, and the rows that it came from.

    Raises:
        A2SError: The source refuses, or is gone.
    """
    drawn = source.sample(
        hyper.batch_rows,
        rng,
        n_step=hyper.n_step,
        gamma=hyper.gamma,
        prioritised=hyper.prioritised,
        beta=hyper.importance_exponent,
    )
    tensors = (torch.from_numpy(getattr(drawn, name)) for name in Transitions._fields)
    return Transitions(*tensors), drawn.row
