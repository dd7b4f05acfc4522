"""What a batch refuses."""

import dataclasses

import pytest
import torch

from a2s.learner.on_policy.batch import Batch


def make() -> Batch:
    """Build a batch of two segments."""
    return Batch(
        obs=torch.zeros(5, 3),
        suggestion=torch.zeros(5, 2),
        log_prob=torch.zeros(5),
        reward=torch.zeros(5),
        lengths=torch.tensor([2, 3]),
        weights_version=torch.tensor([0, 0]),
        final_obs=torch.zeros(2, 3),
        terminated=torch.tensor([True, False]),
        truncated=torch.tensor([False, False]),
        episode_returns=torch.zeros(1),
    )


def test_last_rows_are_the_ends_of_the_segments() -> None:
    """Segments lie one after the other."""
    assert make().last.tolist() == [1, 4]
    assert make().num_steps == 5


@pytest.mark.parametrize(
    "name",
    ["obs", "suggestion", "log_prob", "weights_version", "final_obs", "terminated", "truncated"],
)
def test_tensors_that_disagree_are_refused_by_name(name: str) -> None:
    """A row too few would otherwise be broadcast or shifted."""
    wrong = getattr(make(), name)[:-1]
    with pytest.raises(ValueError, match=f"batch: {name}: found shape"):
        dataclasses.replace(make(), **{name: wrong})


@pytest.mark.parametrize("lengths", [[2, 2], [5, 0], [6, -1]])
def test_lengths_must_sum_to_the_steps(lengths: list[int]) -> None:
    """The lengths alone say where a segment ends."""
    with pytest.raises(ValueError, match="expected a sum of 5 steps"):
        dataclasses.replace(make(), lengths=torch.tensor(lengths))
