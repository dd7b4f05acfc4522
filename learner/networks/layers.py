"""The layers of a network that is evaluated by several members at once, forward and backward.

Each layer knows where its parameters are in `Weights`, maps ``[E, N, in]`` to ``[E, N, out]`` and
remembers what its gradient needs. Everything is in the precision of the weights that are given;
normalisation adds up in float32, and its gain and offset are float32.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from a2s.learner.networks.layer_norm import Affine, Normed, layer_norm, layer_norm_back

_aten = torch.ops.aten


class Weights(NamedTuple):
    """The parameters of E members, or their gradients, by number.

    Attributes:
        full: Each ``[E, rows, columns]``, float32.
        product: The same in the precision of matrix products.
        affine: Those of a normalisation together, by the number of its gain.
    """

    full: list[Tensor]
    product: list[Tensor]
    affine: dict[int, Affine]


class Layer(Protocol):
    """One step of a network and its gradient."""

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Any]:
        """Map ``[E, N, in]`` to ``[E, N, out]``, and give what `backward` needs."""

    def backward(self, weights: Weights, grads: Weights | None, seen: Any, grad: Tensor) -> Tensor:
        """Turn the gradient by the output into that by the input.

        Args:
            weights: As in `forward`.
            grads: Gradients of the parameters, to be overwritten; ``None``: not wanted.
            seen: From `forward`.
            grad: ``[E, N, out]``.
        """


class Linear:
    """``x W + b``.

    Args:
        weight: Number of W, ``[E, in, out]``.
        bias: Number of b, ``[E, 1, out]``.
        adds_bias: ``False``: the normalisation above adds it, in the pass that it makes anyway.
    """

    def __init__(self, weight: int, bias: int, *, adds_bias: bool = True) -> None:
        self.weight = weight
        self.bias = bias
        self.adds_bias = adds_bias

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Multiply and add."""
        weight = weights.product[self.weight]
        x = x.to(weight.dtype)
        return self.multiply(weights, x, weight), x

    def multiply(self, weights: Weights, x: Tensor, weight: Tensor) -> Tensor:
        """Multiply by W or some of its rows, and add b if that is to be done here."""
        if not self.adds_bias:
            return torch.bmm(x, weight)
        bias = weights.product[self.bias]
        if _is_column(weight):
            return (x * weight.mT).sum(-1, keepdim=True) + bias
        return torch.baddbmm(bias, x, weight)

    def backward(
        self, weights: Weights, grads: Weights | None, seen: Tensor, grad: Tensor
    ) -> Tensor:
        """Go through the product."""
        weight = weights.product[self.weight]
        grad = grad.to(weight.dtype)
        if grads is not None:
            self.collect(grads, seen, grad)
        return grad * weight.mT if _is_column(weight) else torch.bmm(grad, weight.mT)

    def collect(self, grads: Weights, seen: Tensor, grad: Tensor) -> None:
        """Overwrite the gradients of W and b; ``grad`` is in the precision of the product."""
        by_weight = grads.full[self.weight]
        if grad.dtype != by_weight.dtype:
            # To let the kernel write float32 costs a copy of what it reads.
            by_weight.copy_(torch.bmm(seen.mT, grad))
        elif _is_column(by_weight):
            torch.sum(seen * grad, dim=1, out=by_weight.squeeze(2))
        else:
            torch.bmm(seen.mT, grad, out=by_weight)
        if self.adds_bias:
            grads.full[self.bias].copy_(grad.sum(1, keepdim=True))


class Relu:
    """``max(x, 0)``, without parameters."""

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Cut at 0, in the memory of the layer below."""
        x = x.relu_()
        return x, x

    def backward(self, _: Weights, __: Weights | None, seen: Tensor, grad: Tensor) -> Tensor:
        """Let through what was above 0."""
        return _above_zero(grad, seen)


class Norm:
    """Layer normalisation with gain and offset, and max(x, 0) where wanted.

    Args:
        gain: Number of the gain, ``[E, 1, width]``.
        offset: Number of the offset, ``[E, 1, width]``.
        relu: Whether to cut at 0.
        bias: Number of the bias that the layer below leaves to this one, if it does.
    """

    def __init__(self, gain: int, offset: int, *, relu: bool, bias: int | None) -> None:
        self.gain = gain
        self.offset = offset
        self.relu = relu
        self.bias = bias

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Normed]:
        """Normalise over the last dimension."""
        normed = layer_norm(x, weights.affine[self.gain], relu=self.relu)
        return normed.out, normed

    def backward(
        self, weights: Weights, grads: Weights | None, seen: Normed, grad: Tensor
    ) -> Tensor:
        """Go through the normalisation."""
        affine = weights.affine[self.gain]
        into = None if grads is None else grads.affine[self.gain]
        return layer_norm_back(seen, grad, affine, relu=self.relu, into=into)

    def gather(self, full: list[Tensor]) -> Affine:
        """Its parameters."""
        bias = None if self.bias is None else full[self.bias]
        return Affine(full[self.gain], full[self.offset], bias)


class Residual:
    """``x + f(x)``, f being layers of its own.

    Args:
        inner: The layers of f.
    """

    def __init__(self, inner: Sequence[Layer]) -> None:
        self.inner = inner

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, list[Any]]:
        """Add what the inner layers say."""
        inside, tape = run(self.inner, weights, x)
        return inside.add_(x), tape

    def backward(
        self, weights: Weights, grads: Weights | None, seen: list[Any], grad: Tensor
    ) -> Tensor:
        """Add what comes through the inner layers to what goes past them."""
        return run_back(self.inner, weights, grads, seen, grad).add_(grad)


def run(layers: Sequence[Layer], weights: Weights, x: Tensor) -> tuple[Tensor, list[Any]]:
    """Go through layers; returns the output, and what `run_back` needs."""
    tape = []
    for layer in layers:
        x, seen = layer.forward(weights, x)
        tape.append(seen)
    return x, tape


def run_back(
    layers: Sequence[Layer],
    weights: Weights,
    grads: Weights | None,
    tape: list[Any],
    grad: Tensor,
) -> Tensor:
    """Go back through layers; returns the gradient by the input of the first."""
    for layer, seen in zip(reversed(layers), reversed(tape), strict=True):
        grad = layer.backward(weights, grads, seen, grad)
    return grad


def _is_column(weight: Tensor) -> bool:
    """Whether to multiply and add up: with one column a product takes five times as long.

    But in bfloat16 it adds up in float32.
    """
    return weight.shape[2] == 1 and weight.dtype != torch.bfloat16


def _above_zero(grad: Tensor, out: Tensor) -> Tensor:
    through: Tensor = _aten.threshold_backward(grad, out, 0)
    return through
