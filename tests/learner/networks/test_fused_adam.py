"""Adam in one kernel, against the six of `optimiser.Adam` and torch's own."""

import torch

from a2s.learner.networks.fused_adam import FusedAdam


def test_steps_are_those_of_adam() -> None:
    """Twenty of them."""
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(3, 50, generator=generator)
    theirs = torch.nn.Parameter(ours.clone())
    adam = FusedAdam(ours, learning_rate=0.01)
    other = torch.optim.Adam([theirs], lr=0.01)
    for _ in range(20):
        grad = torch.randn(3, 50, generator=generator)
        adam.step(grad)
        theirs.grad = grad
        other.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-6)
    assert float(adam.tensors()["steps"]) == 20


def test_first_step_has_the_length_of_the_learning_rate() -> None:
    """Whatever the gradient; of one without any, 0."""
    value = torch.zeros(3)
    FusedAdam(value, learning_rate=0.5).step(torch.tensor([1e-3, -7.0, 0.0]))
    torch.testing.assert_close(value, torch.tensor([-0.5, 0.5, 0.0]), rtol=1e-4, atol=1e-6)
