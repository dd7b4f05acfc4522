"""The on-policy trainer: its batches, and by which networks they were played."""

import numpy as np
import pytest
import torch
from segments import segment

from a2s.learner.on_policy.batch import Batch
from a2s.learner.on_policy.update import OnPolicy
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.run.config import on_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.fields import Spaces

SPACES = Spaces(obs_size=2, action_low=-np.ones(1, np.float32), action_high=np.ones(1, np.float32))
Learned = list[tuple[Batch, bool]]


@pytest.fixture
def trainer() -> OnPolicyTrainer:
    """Make one whose networks were not published yet."""
    return OnPolicyTrainer(SPACES, on_policy("modern", "a2s", {}), 0, {}, LearnerMetrics())


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> Learned:
    """Batches that were learned from, and whether older networks had played them."""
    found: Learned = []
    update = OnPolicy.update

    def heard(self: OnPolicy, batch: Batch, progress: float, *, is_behind: bool) -> object:
        found.append((batch, is_behind))
        return update(self, batch, progress, is_behind=is_behind)

    monkeypatch.setattr(OnPolicy, "update", heard)
    return found


def test_actors_wait_while_a_whole_batch_waits(trainer: OnPolicyTrainer) -> None:
    assert trainer.hold_s(0.99) == 0.0
    assert trainer.hold_s(1.0) > 0.0


def test_a_batch_is_what_was_stored_before_it_was_closed_in_the_order_of_places(
    trainer: OnPolicyTrainer, learned: Learned
) -> None:
    played = [(1, 0, 0), (0, 1, 1), (0, 0, 2), (0, 0, 3)]
    for slot, env, seq in played:
        trainer.store(slot, segment(seq, env=env))
    trainer.close_batch()
    trainer.store(0, segment(9))
    trainer.learn(0.0)
    expected = np.concatenate([segment(seq).obs for seq in (2, 3, 1, 0)])
    assert torch.equal(learned[0][0].obs, torch.from_numpy(expected))


@pytest.mark.parametrize(
    ("overlaps", "expected"), [(True, [False, True, True]), (False, [False] * 3)]
)
def test_a_batch_that_was_played_during_an_update_is_of_the_networks_before(
    trainer: OnPolicyTrainer,
    learned: Learned,
    overlaps: bool,
    expected: list[bool],
) -> None:
    """Published when a batch is complete, or only when it was learned from."""
    trainer.graph(1, 0.0)
    for version in (1, 2, 3):
        trainer.store(0, segment(version, weights_version=version))
        trainer.close_batch()
        if overlaps:
            trainer.graph(version + 1, 0.0)
        trainer.learn(0.0)
        if not overlaps:
            trainer.graph(version + 1, 0.0)
    assert [is_behind for _, is_behind in learned] == expected
