"""Compiled gradient steps against autograd and Adam of torch."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from a2s.learner.networks import step_kernels
from a2s.learner.networks.adam import Adam
from a2s.learner.networks.compiled import outputs, run_together, vectors
from a2s.learner.networks.ensemble import Ensemble
from a2s.learner.networks.form import Form
from a2s.learner.networks.options import Activation


def make(
    sizes: tuple[int, ...], activation: Activation, layer_norm: bool, members: int, seed: int
) -> Ensemble:
    """Weights none of which is at its first value; 0 members: a single network."""
    generator = torch.Generator().manual_seed(seed)
    form = Form(sizes, activation=activation, layer_norm=layer_norm)
    flat = form.draw(members or 1, generator)
    flat += 0.2 * torch.randn(flat.shape, generator=generator)
    return Ensemble(form, flat, single=members == 0)


@given(
    sizes=st.lists(st.integers(2, 40), min_size=2, max_size=4),
    activation=st.sampled_from(["silu", "tanh"]),
    layer_norm=st.booleans(),
    members=st.integers(0, 3),
    rows=st.integers(1, 9),
    seed=st.integers(0, 99),
)
@settings(deadline=None)
def test_outputs_and_gradients_are_those_of_the_layers(
    sizes: list[int],
    activation: Activation,
    layer_norm: bool,
    members: int,
    rows: int,
    seed: int,
) -> None:
    """Which ``test_ensemble`` compares to autograd; in room for more rows, of every member."""
    network = make(tuple(sizes), activation, layer_norm, members, seed)
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(rows, sizes[0], generator=generator)
    weight = torch.randn(*((members,) if members else ()), rows, sizes[-1], generator=generator)
    expected, tape = network.trace(x)
    network.differentiate(tape, weight)
    optimiser, grad = Adam(network.value), torch.full_like(network.grad, math.nan)
    for member in range(network.members):
        net = vectors(optimiser, network, grad, member=member)
        mem = step_kernels.memory(net.layout, rows + 3)
        out = step_kernels.forward(net.value, net.layout, x.numpy(), mem)
        wanted = expected[member] if members else expected
        np.testing.assert_allclose(out, wanted, rtol=1e-4, atol=1e-5)
        by_out = (weight[member] if members else weight).numpy()
        step_kernels.backward(net.value, net.grad, net.layout, x.numpy(), mem, by_out)
    written = ~torch.isnan(grad)
    assert int(written.sum()) == sum((r + 1) * c for r, c in network.form.linears) * max(
        members, 1
    ) + 2 * sum(layer_norm * width for width in sizes[1:-1]) * max(members, 1)
    # Where the numbers of a row are nearly equal, rounding of their mean is divided twice.
    scale = float(network.grad.abs().max().clamp(min=1.0))
    torch.testing.assert_close(
        grad[written] / scale, network.grad[written] / scale, rtol=0.0, atol=1e-3
    )
    torch.testing.assert_close(
        (grad[written] / scale).abs().mean(), (network.grad[written] / scale).abs().mean(),
        rtol=1e-4, atol=1e-6,
    )  # fmt: skip


@pytest.mark.parametrize("most", [0.0, 0.1])
def test_steps_of_adam_are_those_of_the_other(most: float) -> None:
    """Twenty of them; the prefix of a policy, its log deviation, is stepped as well."""
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(50, generator=generator)
    theirs, moments = ours.clone(), [np.zeros(50, np.float32) for _ in range(2)]
    adam = Adam(theirs)
    for step in range(1, 21):
        grad = torch.randn(50, generator=generator)
        adam.step(grad.clone(), 0.01, most)
        step_kernels.shorten(grad.numpy(), most)
        step_kernels.adam(ours.numpy(), grad.numpy(), *moments, step, 0.01)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_a_member_steps_its_own_parameters_alone() -> None:
    """Layers of the members lie side by side."""
    network = make((3, 8, 4), "silu", True, 2, 0)
    before, optimiser = network.value.clone(), Adam(network.value)
    grad = torch.ones_like(network.grad)
    for member in (0, 1):
        net = vectors(optimiser, network, grad, member=member)
        step_kernels.adam_of_layers(*net, 1, 0.5)
        moved = (network.value != before).sum()
        assert int(moved) == (member + 1) * (3 * 8 + 8 + 8 * 4 + 4 + 2 * 8)
    changed = network.value != before
    torch.testing.assert_close(network.value[changed], before[changed] - 0.5)


@pytest.mark.parametrize(("name", "most"), [("exp", 5e-7), ("sigmoid", 5e-7)])
def test_error_of_the_approximations(name: str, most: float) -> None:
    """Relative to the exact one, in double precision, over all that is not limited."""
    function = getattr(step_kernels, name)
    x = np.linspace(-79, 79, 20_001, dtype=np.float32)
    found = np.array([function(each) for each in x], np.float64)
    exact = np.exp(x.astype(np.float64))
    if name == "sigmoid":
        exact = 1.0 / (1.0 + np.exp(-x.astype(np.float64)))
    assert np.abs(found / exact - 1.0).max() < most
    assert np.isnan(function(np.float32(np.nan)))


def test_outputs_are_those_of_the_layers_in_any_number_of_rows() -> None:
    """Two networks at once; more rows than are evaluated at once."""
    nets = [make((5, 16, 2), "tanh", True, 0, seed) for seed in (0, 1)]
    x = torch.randn(1300, 5)
    found = outputs((nets[0], x), (nets[1], x[:7]))
    torch.testing.assert_close(found[0], nets[0](x), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found[1], nets[1](x[:7]), rtol=1e-4, atol=1e-5)


def test_calls_run_side_by_side_and_keep_their_order() -> None:
    """An error of one is the caller's."""
    assert run_together([lambda: 1, lambda: 2, lambda: 3]) == [1, 2, 3]
    with pytest.raises(ZeroDivisionError):
        run_together([lambda: 1, lambda: 1 // 0])
