"""What a batch refuses."""

import dataclasses

import pytest
import torch
from on_policy_learners import batch_of

BATCH = batch_of(torch.zeros(5), [2, 3], [True, False])


@pytest.mark.parametrize(
    "name",
    ["obs", "suggestion", "log_prob", "weights_version", "final_obs", "terminated", "truncated"],
)
def test_tensors_that_disagree_are_refused_by_name(name: str) -> None:
    """A row too few would otherwise be broadcast or shifted."""
    wrong = getattr(BATCH, name)[:-1]
    with pytest.raises(ValueError, match=f"batch: {name}: found shape"):
        dataclasses.replace(BATCH, **{name: wrong})


@pytest.mark.parametrize("lengths", [[2, 2], [5, 0], [6, -1]])
def test_lengths_must_sum_to_the_steps(lengths: list[int]) -> None:
    """The lengths alone say where a segment ends."""
    with pytest.raises(ValueError, match="expected a sum of 5 steps"):
        dataclasses.replace(BATCH, lengths=torch.tensor(lengths))
