"""Networks with their gradient written out, against modules and autograd."""

import itertools

import pytest
import torch
from plain_sac import modules

from a2s.learner.networks.ensemble import Ensemble, score_many
from a2s.learner.networks.form import Form
from a2s.learner.networks.options import Activation, Init, Network

FORMS = [
    ((5, 16, 8, 3), "mlp"),
    ((5, 16, 3), "mlp"),
    ((5, 16, 8, 24, 3), "residual"),
    ((5, 16, 3), "residual"),
    ((5, 16, 8, 3), "trunk"),
    ((5, 16, 8, 24, 3), "trunk"),
]


def make(
    sizes: tuple[int, ...],
    network: Network,
    layer_norm: bool = True,
    members: int = 3,
    activation: Activation = "relu",
    single: bool = False,
) -> Ensemble:
    """Weights none of which is at its first value."""
    generator = torch.Generator().manual_seed(3)
    form = Form(sizes, network=network, activation=activation, layer_norm=layer_norm, late=2)
    flat = form.draw(members, generator)
    flat += 0.2 * torch.randn(flat.shape, generator=generator)
    return Ensemble(form, flat, single=single)


@pytest.mark.parametrize(
    ("shape", "layer_norm", "activation", "members"),
    list(itertools.product(FORMS, [True, False], ["relu", "silu", "tanh"], [0, 1, 3])),
)
def test_outputs_and_gradients_are_those_of_autograd(
    shape: tuple[tuple[int, ...], Network],
    layer_norm: bool,
    activation: Activation,
    members: int,
) -> None:
    """By the parameters, by the input, and by a part of the input; 0 members: a single network."""
    ensemble = make(*shape, layer_norm, members or 1, activation, single=members == 0)
    nets = modules(ensemble)
    x = torch.randn(7, 5, requires_grad=True)
    weight = torch.randn(members, 7, 3) if members else torch.randn(7, 3)
    expected = torch.stack([net(x) for net in nets]) if members else nets[0](x)
    torch.autograd.backward((expected * weight).sum())
    found, tape = ensemble.trace(x.detach())
    torch.testing.assert_close(found, expected.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(ensemble(x.detach()), expected.detach(), rtol=1e-5, atol=1e-5)
    ensemble.grad.fill_(float("nan"))  # to be overwritten, not added to
    ensemble.differentiate(tape, weight)
    theirs = Ensemble(ensemble.form, ensemble.grad, single=ensemble.single)
    assert x.grad is not None
    for net, grads in zip(nets, modules(theirs), strict=True):
        for wanted, grad in zip(net.parameters(), grads.parameters(), strict=True):
            assert wanted.grad is not None
            torch.testing.assert_close(grad.data, wanted.grad, rtol=1e-4, atol=1e-5)
    for start in (3,) if shape[1] == "trunk" else (0, 2, 3):
        by_input = ensemble.by_input(ensemble.trace(x.detach())[1], weight, start)
        by_input = by_input.sum(0) if members else by_input
        torch.testing.assert_close(by_input, x.grad[:, start:], rtol=1e-4, atol=1e-5)


def test_a_trunk_has_no_gradient_by_what_it_sees() -> None:
    ensemble = make((5, 16, 8, 3), "trunk")
    out, tape = ensemble.trace(torch.randn(7, 5))
    with pytest.raises(ValueError, match="found 3 inputs"):
        ensemble.by_input(tape, torch.ones_like(out), 2)


def test_padding_stays_zero() -> None:
    """It is in the optimiser's vector, and must not wander."""
    ensemble = make((5, 3, 1), "mlp", members=2)
    out, tape = ensemble.trace(torch.randn(4, 5))
    ensemble.differentiate(tape, torch.ones_like(out))
    assert len(ensemble.value) == 64  # 28 parameters of each member, and 4 of padding
    assert ensemble.grad[-8:].tolist() == [0.0] * 8
    assert bool((ensemble.grad[:-8] != 0).any())


@pytest.mark.parametrize("network", ["mlp", "trunk"])
@pytest.mark.parametrize("bf16", [False, True])
def test_several_actions_score_as_one_by_one(bf16: bool, network: Network) -> None:
    """The observation's part is computed once: of the first layer, or the whole trunk."""
    exact = make((6, 16, 8, 2), network)
    ensemble = Ensemble(exact.form, exact.value, bf16=bf16)
    obs, action = torch.randn(9, 4), torch.randn(3, 9, 5, 2)
    found = ensemble.score(obs, action)
    near = 0.05 if bf16 else 1e-5
    for member, k in itertools.product(range(3), range(5)):
        alone = ensemble(torch.cat([obs, action[member, :, k]], 1))[member].mean(1)
        torch.testing.assert_close(found[member, :, k], alone, rtol=near, atol=near)


def test_a_single_network_scores_as_one_member() -> None:
    many = make((6, 16, 8, 1), "mlp", members=1, activation="tanh")
    single = Ensemble(many.form, many.value, single=True)
    obs, action = torch.randn(9, 4), torch.randn(9, 5, 2)
    found = single.score(obs, action)
    assert found.shape == (9, 5)
    torch.testing.assert_close(found, many.score(obs, action.unsqueeze(0))[0])


def test_picked_members_answer_for_themselves() -> None:
    """In any order, twice too."""
    ensemble = make((6, 16, 2), "residual")
    obs, action = torch.randn(9, 4), torch.randn(9, 5, 2)
    every = ensemble.score(obs, action.expand(3, -1, -1, -1))
    index = torch.tensor([2, 0, 2, 1])
    picked = ensemble.weights.pick(index)
    found = score_many(ensemble.form, picked, obs, action.expand(4, -1, -1, -1))
    torch.testing.assert_close(found, every[index], rtol=1e-5, atol=1e-5)


def test_copy_has_parameters_of_its_own() -> None:
    """It is what target networks are."""
    ensemble = make((3, 8, 1), "mlp")
    copy = ensemble.copy()
    x = torch.randn(4, 3)
    before = copy(x)
    ensemble.value.zero_()
    assert torch.equal(copy(x), before)
    assert not torch.equal(ensemble(x), before)


@pytest.mark.parametrize("picked", [False, True])
def test_bf16_products_follow_the_parameters_when_refreshed(picked: bool) -> None:
    """They are made from a copy."""
    exact = make((3, 8, 1), "mlp", layer_norm=False, members=2)
    rough = Ensemble(exact.form, exact.value.clone(), bf16=True)
    exact.value.mul_(2.0)
    rough.value.mul_(2.0)
    rough.refresh()
    obs, action = torch.randn(4, 2), torch.randn(2, 4, 1, 1)
    index = torch.tensor([0, 1])
    both = [(each.weights.pick(index) if picked else each.weights) for each in (exact, rough)]
    wanted, found = (score_many(exact.form, each, obs, action) for each in both)
    torch.testing.assert_close(found, wanted, rtol=0.05, atol=0.05)
    assert not torch.equal(found, wanted)


@pytest.mark.parametrize(
    ("init", "limits", "bias_limits"),
    [("fan-in", (0.1, 0.05), (0.1, 0.05)), ("uniform", (1.0, 0.1), (0.0, 0.0))],
)
def test_uniform_first_weights_fill_their_range(
    init: Init, limits: tuple[float, float], bias_limits: tuple[float, float]
) -> None:
    """``fan-in``, torch's: +-1/sqrt(inputs), biases too; ``uniform``, the authors': biases 0."""
    form = Form((100, 400, 1), activation="relu", layer_norm=True)
    first = form.weights(form.draw(2, torch.Generator().manual_seed(0), init=init))
    for found, wanted in ((first.weight, limits), (first.bias, bias_limits)):
        for tensor, limit in zip(found, wanted, strict=True):
            assert 0.9 * limit <= float(tensor.abs().max()) <= limit
            assert 0.9 * limit <= float(-tensor.min()) or tensor.numel() == 2
    assert not torch.equal(first.weight[0][0], first.weight[0][1])
    assert all(bool((norm.gain == 1).all() and (norm.offset == 0).all()) for norm in first.norms)


def test_orthogonal_first_weights_have_their_gains() -> None:
    """sqrt(2) inside, ``output_gain`` at the output."""
    form = Form((64, 64, 64, 3), activation="tanh", layer_norm=False)
    flat = form.draw(1, torch.Generator().manual_seed(0), init="orthogonal", output_gain=0.01)
    _, inner, last = form.weights(flat, single=True).weight
    torch.testing.assert_close(inner @ inner.T, 2.0 * torch.eye(64), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(last.T @ last, 1e-4 * torch.eye(3), atol=1e-7, rtol=0.0)
