"""The on-policy trainer."""

import numpy as np

from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.run.config import on_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.fields import Spaces

SPACES = Spaces(
    obs_size=3,
    action_low=np.full(2, -1, dtype=np.float32),
    action_high=np.full(2, 1, dtype=np.float32),
)


def test_actors_wait_while_a_whole_batch_waits() -> None:
    trainer = OnPolicyTrainer(SPACES, on_policy("modern", "a2s", {}), 0, {}, LearnerMetrics())
    assert trainer.hold_s(0.99) == 0.0
    assert trainer.hold_s(1.0) > 0.0
