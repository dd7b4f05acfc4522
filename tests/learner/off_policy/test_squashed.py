"""The tanh-Gaussian policy."""

import torch

from a2s.learner.off_policy.squashed import gaussian


def test_log_std_is_held_within_its_range() -> None:
    """And has no gradient at the ends."""
    found = gaussian(torch.tensor([[1.0, 2.0, 3.0, 9.0, -0.5, -99.0]]))
    assert found.mean.tolist() == [[1.0, 2.0, 3.0]]
    assert found.log_std.tolist() == [[2.0, -0.5, -10.0]]
    assert found.free.tolist() == [[0.0, 1.0, 0.0]]
