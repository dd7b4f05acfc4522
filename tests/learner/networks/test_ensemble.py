"""Networks with their gradient written out, against modules and autograd."""

import itertools

import pytest
import torch
from plain_sac import modules

from a2s.learner.networks.ensemble import Ensemble, Form, score_many
from a2s.learner.off_policy.config import Network

FORMS = [
    ((5, 16, 8, 3), "mlp"),
    ((5, 16, 3), "mlp"),
    ((5, 16, 8, 24, 3), "residual"),
    ((5, 16, 3), "residual"),
    ((5, 16, 8, 3), "trunk"),
    ((5, 16, 8, 24, 3), "trunk"),
]


def make(sizes: tuple[int, ...], network: Network, layer_norm: bool, members: int) -> Ensemble:
    """Weights none of which is at its first value."""
    generator = torch.Generator().manual_seed(3)
    form = Form(sizes, network=network, layer_norm=layer_norm, late=2)
    flat = form.draw(members, generator)
    for view in form.views(flat):
        view += 0.2 * torch.randn(view.shape, generator=generator)
    return Ensemble(form, flat, precision="f32")


@pytest.mark.parametrize(
    ("shape", "layer_norm", "members"), list(itertools.product(FORMS, [True, False], [1, 3]))
)
def test_outputs_and_gradients_are_those_of_autograd(
    shape: tuple[tuple[int, ...], Network], layer_norm: bool, members: int
) -> None:
    """By the parameters, by the input, and by a part of the input."""
    ensemble = make(*shape, layer_norm, members)
    nets = modules(ensemble)
    x = torch.randn(7, 5, requires_grad=True)
    weight = torch.randn(members, 7, 3)
    expected = torch.stack([net(x) for net in nets])
    torch.autograd.backward((expected * weight).sum())
    found, tape = ensemble.trace(x.detach())
    torch.testing.assert_close(found, expected.detach(), rtol=1e-5, atol=1e-5)
    ensemble.grad.fill_(float("nan"))  # to be overwritten, not added to
    ensemble.differentiate(tape, weight)
    theirs = Ensemble(ensemble.form, ensemble.grad, precision="f32")
    assert x.grad is not None
    for net, grads in zip(nets, modules(theirs), strict=True):
        for wanted, grad in zip(net.parameters(), grads.parameters(), strict=True):
            assert wanted.grad is not None
            torch.testing.assert_close(grad.data, wanted.grad, rtol=1e-4, atol=1e-5)
    for start in (3,) if shape[1] == "trunk" else (0, 2, 3):
        by_input = ensemble.by_input(ensemble.trace(x.detach())[1], weight, start).sum(0)
        torch.testing.assert_close(by_input, x.grad[:, start:], rtol=1e-4, atol=1e-5)


def test_a_trunk_has_no_gradient_by_what_it_sees() -> None:
    ensemble = make((5, 16, 8, 3), "trunk", True, 1)
    out, tape = ensemble.trace(torch.randn(7, 5))
    with pytest.raises(ValueError, match="found 3 inputs"):
        ensemble.by_input(tape, torch.ones_like(out), 2)


def test_padding_between_parameters_stays_zero() -> None:
    """It is in the optimiser's vector, and must not wander."""
    ensemble = make((5, 3, 1), "mlp", True, 2)
    out, tape = ensemble.trace(torch.randn(4, 5))
    ensemble.differentiate(tape, torch.ones_like(out))
    used = torch.zeros_like(ensemble.value)
    for view in ensemble.form.views(used):
        view.fill_(1.0)
    assert bool((ensemble.grad[used == 0] == 0).all())
    assert bool((ensemble.value[used == 0] == 0).all())
    assert 0 < int((used == 0).sum()) < used.numel()


@pytest.mark.parametrize("network", ["mlp", "trunk"])
@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_several_actions_score_as_one_by_one(precision: str, network: Network) -> None:
    """The observation's part is computed once: of the first layer, or the whole trunk."""
    exact = make((6, 16, 8, 2), network, True, 3)
    ensemble = Ensemble(exact.form, exact.value, precision=precision)  # type: ignore[arg-type]
    obs, action = torch.randn(9, 4), torch.randn(3, 9, 5, 2)
    found = score_many(ensemble.form, ensemble.weights, obs, action)
    near = 1e-5 if precision == "f32" else 0.05
    for member, k in itertools.product(range(3), range(5)):
        alone = ensemble(torch.cat([obs, action[member, :, k]], 1))[member]
        torch.testing.assert_close(found[member, :, k], alone, rtol=near, atol=near)


def test_picked_members_answer_for_themselves() -> None:
    """In any order, twice too."""
    ensemble = make((6, 16, 2), "residual", True, 3)
    obs, action = torch.randn(9, 4), torch.randn(9, 5, 2)
    every = score_many(ensemble.form, ensemble.weights, obs, action.expand(3, -1, -1, -1))
    index = torch.tensor([2, 0, 2, 1])
    picked = ensemble.pick(index)
    found = score_many(ensemble.form, picked, obs, action.expand(4, -1, -1, -1))
    torch.testing.assert_close(found, every[index], rtol=1e-5, atol=1e-5)


def test_copy_has_parameters_of_its_own() -> None:
    """It is what target networks are."""
    ensemble = make((3, 8, 1), "mlp", True, 2)
    copy = ensemble.copy()
    x = torch.randn(4, 3)
    before = copy(x)
    ensemble.value.zero_()
    assert torch.equal(copy(x), before)
    assert not torch.equal(ensemble(x), before)


@pytest.mark.parametrize("picked", [False, True])
def test_bf16_products_follow_the_parameters_when_refreshed(picked: bool) -> None:
    """They are made from a copy."""
    exact = make((3, 8, 1), "mlp", False, 2)
    rough = Ensemble(exact.form, exact.value.clone(), precision="bf16")
    exact.value.mul_(2.0)
    rough.value.mul_(2.0)
    rough.refresh()
    obs, action = torch.randn(4, 2), torch.randn(2, 4, 1, 1)
    index = torch.tensor([0, 1])
    both = [(each.pick(index) if picked else each.weights) for each in (exact, rough)]
    wanted, found = (score_many(exact.form, each, obs, action) for each in both)
    torch.testing.assert_close(found, wanted, rtol=0.05, atol=0.05)
    assert not torch.equal(found, wanted)


def test_first_weights_are_those_of_torch() -> None:
    """Uniform in +-1/sqrt(inputs), the bias too; gains 1, offsets 0."""
    form = Form((100, 400, 1), network="mlp", layer_norm=True)
    flat = form.draw(2, torch.Generator().manual_seed(0))
    weight, bias, gain, offset, last, last_bias = form.views(flat)
    assert 0.099 < float(weight.max()) <= 0.1
    assert -0.1 <= float(weight.min()) < -0.099
    assert 0.09 < float(bias.abs().max()) <= 0.1
    assert 0.049 < float(last.abs().max()) <= 0.05
    assert 0 < float(last_bias.abs().max()) <= 0.05
    assert bool((gain == 1).all())
    assert bool((offset == 0).all())
    assert not torch.equal(weight[0], weight[1])
