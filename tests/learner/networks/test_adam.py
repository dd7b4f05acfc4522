"""Adam in one kernel against torch's own."""

import pytest
import torch

from a2s.learner.networks.adam import Adam


@pytest.mark.parametrize("max_norm", [0.0, 0.1])
def test_steps_are_those_of_torch(max_norm: float) -> None:
    """Twenty of them, with and without a limit on the gradient's norm.

    Our step calls torch's private ``_fused_adam_``. If this fails since that is gone or takes other
    arguments, write Adam out in ``adam.py`` as in Kingma and Ba 2015, with the number of steps as
    a tensor on the device: six kernels, equal to rounding, and four times as slow.
    """
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(3, 50, generator=generator)
    theirs = torch.nn.Parameter(ours.clone())
    adam = Adam(ours)
    other = torch.optim.Adam([theirs], lr=0.01)
    for _ in range(20):
        grad = torch.randn(3, 50, generator=generator)
        theirs.grad = grad.clone()
        adam.step(grad, 0.01, max_norm)
        if max_norm:
            torch.nn.utils.clip_grad_norm_([theirs], max_norm)
        other.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-6)
    assert float(adam.tensors()["steps"]) == 20


def test_first_step_has_the_length_of_the_learning_rate() -> None:
    """Whatever the gradient; of one without any, 0."""
    value = torch.zeros(3)
    Adam(value).step(torch.tensor([1e-3, -7.0, 0.0]), 0.5)
    torch.testing.assert_close(value, torch.tensor([-0.5, 0.5, 0.0]), rtol=1e-4, atol=1e-6)
