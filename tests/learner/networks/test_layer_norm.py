"""Layer normalisation with gain, offset and a cut at 0, against autograd in float64."""

import dataclasses
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from a2s.learner.networks.layer_norm import LAYER_NORM_EPS, Norm
from a2s.learner.networks.weights import Affine, Weights

EXACT = {torch.float64: 1e-12, torch.float32: 1e-5, torch.bfloat16: 2.0**-8}


def drawn(members: int, width: int, kind: torch.dtype, generator: torch.Generator) -> Affine:
    """Parameters that all differ."""
    exact = torch.float64 if kind == torch.float64 else torch.float32
    made = [torch.randn(members, 1, width, generator=generator, dtype=exact) for _ in range(3)]
    return Affine(*made)


def autograd(x: Tensor, affine: Affine, grad: Tensor) -> tuple[Tensor, ...]:
    """What comes out without a cut, and the gradients by x, gain, offset and bias."""
    inputs = [each.detach().double().requires_grad_() for each in (x, *tensors(affine))]
    wide, gain, offset, bias = inputs
    out = F.layer_norm(wide + bias, x.shape[-1:], eps=LAYER_NORM_EPS) * gain + offset
    return out.detach(), *torch.autograd.grad(out, inputs, grad.double())


def tensors(affine: Affine) -> list[Tensor]:
    """Those that are there."""
    every = (affine.gain, affine.offset, affine.bias)
    return [each for each in every if each is not None]


def only(affine: Affine) -> Weights:
    """Those of a network that is one normalisation."""
    return Weights([], [], [affine])


def assert_close(found: Tensor, wanted: Tensor, tolerance: float) -> None:
    """Relative to the largest number, if that is above 1."""
    scale = float(wanted.abs().max().clamp(min=1.0))
    torch.testing.assert_close(
        found.double() / scale, wanted.double() / scale, rtol=0.0, atol=tolerance
    )


@given(
    shape=st.tuples(st.integers(1, 3), st.integers(1, 9), st.integers(2, 70)),
    relu=st.booleans(),
    biased=st.booleans(),
    compiled=st.booleans(),
    kind=st.sampled_from(list(EXACT)),
    seed=st.integers(0, 99),
)
@settings(deadline=None)
def test_values_and_gradients_are_those_of_autograd(
    shape: tuple[int, int, int],
    relu: bool,
    biased: bool,
    compiled: bool,
    kind: torch.dtype,
    seed: int,
) -> None:
    """Compiled or not; widths that fill no vector register among them."""
    generator = torch.Generator().manual_seed(seed)
    x, grad = (torch.randn(shape, generator=generator).to(kind) for _ in range(2))
    affine = drawn(shape[0], shape[2], kind, generator)
    into = Affine(*(torch.full_like(each, torch.nan) for each in tensors(affine)))
    without = dataclasses.replace(affine, bias=torch.zeros_like(affine.gain))
    if not biased:
        affine, into = dataclasses.replace(affine, bias=None), dataclasses.replace(into, bias=None)
    tape: list[Any] = []
    norm = Norm(0, relu=relu, compiled=compiled)
    normed = norm.forward(only(affine), x, tape)
    through = norm.backward(only(affine), only(into), tape[0], grad)
    assert normed.dtype == through.dtype == kind
    kept = grad * (normed > 0) if relu else grad  # rounding may decide what is cut
    out, by_x, *by_affine = autograd(x, affine if biased else without, kept)
    assert_close(normed, out.relu() if relu else out, EXACT[kind])
    rows = x.double() + (0.0 if affine.bias is None else affine.bias)
    # Where the numbers of a row are nearly equal, rounding of their mean is divided twice.
    squeezed = float(rows.var(2, correction=0).min()) + LAYER_NORM_EPS
    rounding = 16 * torch.finfo(affine.gain.dtype).eps / squeezed
    assert_close(through, by_x, max(EXACT[kind], rounding))
    for found, wanted in zip(tensors(into), by_affine, strict=False):
        assert_close(found, wanted, max(1e-2 if kind == torch.bfloat16 else 1e-4, rounding))


def test_bfloat16_is_rounded_to_the_nearest_and_ties_to_even() -> None:
    """By hand: a row (-a, a) becomes (-1, 1), to which the offset is added, and then rounded."""
    x = torch.tensor([[[-4096.0, 4096.0]]], dtype=torch.bfloat16)
    half = torch.tensor([[[2.0**-8, 2.0**-8]]])  # 1 + 2^-8 is between 1 and 1 + 2^-7
    norm = Norm(0, compiled=True)
    found = norm.forward(only(Affine(torch.ones(1, 1, 2), half, None)), x, None)
    assert found.float().tolist() == [[[-1.0 + 2.0**-8, 1.0]]]
    found = norm.forward(only(Affine(torch.ones(1, 1, 2), 3.0 * half, None)), x, None)
    assert found.float()[0, 0, 1] == 1.0 + 2.0**-6


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_gradients_that_are_not_wanted_are_not_written(kind: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    x, affine = torch.randn(2, 4, 8, dtype=kind), drawn(2, 8, kind, generator)
    before = [each.clone() for each in tensors(affine)]
    tape: list[Any] = []
    norm = Norm(0, relu=True, compiled=True)
    norm.forward(only(affine), x, tape)
    without = norm.backward(only(affine), None, tape[0], x)
    assert all(torch.equal(*pair) for pair in zip(tensors(affine), before, strict=True))
    into = Affine(*(torch.zeros_like(each) for each in before))
    assert torch.equal(without, norm.backward(only(affine), only(into), tape[0], x))
    assert all(bool(each.any()) for each in tensors(into))


def test_memory_in_another_order_is_read_right() -> None:
    """As what a trunk hands down, which is a part of something wider."""
    affine = drawn(2, 8, torch.float32, torch.Generator().manual_seed(0))
    part = torch.randn(2, 4, 11)[..., 3:]
    tape: list[Any] = []
    norm, weights = Norm(0, relu=True, compiled=True), only(affine)
    found = norm.forward(weights, part, tape)
    assert torch.equal(found, norm.forward(weights, part.clone(), None))
    back = norm.backward(weights, None, tape[0], part)
    assert torch.equal(back, norm.backward(weights, None, tape[0], part.clone()))
