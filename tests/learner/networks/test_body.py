"""The gradient that is written out is that of autograd."""

import pytest
import torch

from a2s.learner.networks.adam import FlatParameters
from a2s.learner.networks.body import Body
from a2s.learner.run.config import on_policy


@pytest.mark.parametrize("layer_norm", [True, False])
def test_outputs_and_gradients_are_those_of_autograd(layer_norm: bool) -> None:
    hyper = on_policy("modern", "a2s", {"layer_norm": layer_norm})
    generator = torch.Generator().manual_seed(1)
    body = Body((5, 16, 8, 3), hyper=hyper, output_gain=1.0, generator=generator)
    parameters = FlatParameters(body)
    parameters.value.add_(0.1 * torch.randn(parameters.value.shape, generator=generator))
    x = torch.randn(7, 5, generator=generator)
    weight = torch.randn(7, 3, generator=generator)
    expected = body(x)
    (expected * weight).sum().backward()
    wanted = parameters.grad.clone()
    parameters.grad.fill_(float("nan"))  # to be overwritten, not added to
    found, layers = body.trace(x)
    body.differentiate(layers, weight)
    torch.testing.assert_close(found, expected.detach(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(parameters.grad, wanted, rtol=1e-5, atol=1e-5)
    assert wanted.abs().max() > 0.1
