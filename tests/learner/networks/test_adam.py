"""Adam on one vector, against torch's own."""

import copy

import pytest
import torch
from torch import nn

from a2s.learner.networks.adam import Adam, FlatParameters


def make_net() -> nn.Sequential:
    """Build the same small network every time."""
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1))


@pytest.mark.parametrize("max_norm", [0.0, 0.1])
def test_steps_are_those_of_adam_with_clipping(max_norm: float) -> None:
    """Twenty steps beside torch's."""
    ours = make_net()
    theirs = copy.deepcopy(ours)
    flat = FlatParameters(ours)
    adam = Adam(flat)
    other = torch.optim.Adam(theirs.parameters(), lr=0.01)
    for _ in range(20):
        x = torch.randn(8, 3)
        flat.grad.zero_()
        torch.autograd.backward(ours(x).square().mean())
        adam.step(0.01, max_norm)
        other.zero_grad()
        torch.autograd.backward(theirs(x).square().mean())
        if max_norm:
            nn.utils.clip_grad_norm_(theirs.parameters(), max_norm)
        other.step()
    for mine, yours in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(mine, yours, atol=1e-6, rtol=1e-5)


def test_parameters_are_views_of_one_vector() -> None:
    """Loading the vector loads the network."""
    net = make_net()
    flat = FlatParameters(net)
    flat.load(torch.arange(26.0))
    assert next(net.parameters())[0].tolist() == [0.0, 1.0, 2.0]
    assert list(net.parameters())[-1].tolist() == [25.0]


def test_two_optimisers_of_one_network_keep_their_own_moments() -> None:
    """Equation 6 and the gradient differ in scale."""
    flat = FlatParameters(net := make_net())
    one, two = Adam(flat), Adam(flat)
    torch.autograd.backward(net(torch.randn(4, 3)).sum())
    one.step(0.01, 0.0)
    assert int(one.state()["steps"]) == 1
    assert int(two.state()["steps"]) == 0
    assert float(two.state()["first"].abs().sum()) == 0.0
