"""The layers of a network, forward and backward.

Every layer works on E members at once, ``[E, N, in]`` to ``[E, N, out]``, and on a single network,
``[N, in]`` to ``[N, out]``. It reads its parameters from `Weights` by number. Where a tape is
given, a list, it appends what its gradient needs.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from a2s.learner.networks import options
from a2s.learner.networks.weights import Weights

_aten = torch.ops.aten


class Layer(Protocol):
    """One step of a network and its gradient."""

    def forward(self, weights: Weights, x: Tensor, tape: list[Any] | None) -> Tensor:
        """Map inputs to outputs; ``x`` may be overwritten."""

    def backward(self, weights: Weights, grads: Weights | None, kept: Any, grad: Tensor) -> Tensor:
        """Turn the gradient by the output into that by the input.

        ``kept`` is what `forward` appended to the tape. The gradients of the parameters, ``grads``,
        are overwritten; ``None``: not wanted.
        """


class Linear:
    """``x W + b``; unless it ``adds_bias``, the normalisation above does, in its own pass."""

    def __init__(self, index: int, *, adds_bias: bool) -> None:
        self.index = index
        self.adds_bias = adds_bias

    def forward(self, weights: Weights, x: Tensor, tape: list[Any] | None) -> Tensor:
        """Multiply and add."""
        weight = weights.weight[self.index]
        x = x.to(weight.dtype)
        if tape is not None:
            tape.append(x)
        return self.multiply(weights, x, weight)

    def multiply(self, weights: Weights, x: Tensor, weight: Tensor) -> Tensor:
        """Multiply by W or some of its rows, and add b if that is to be done here."""
        if not self.adds_bias:
            return product(x, weight)
        bias = weights.bias[self.index]
        if weight.dim() == 2:
            return torch.addmm(bias, x, weight)
        if _is_slow(weight):
            return (x * weight.mT).sum(-1, keepdim=True) + bias
        if weight.shape[1] == 1:  # of which a batched product of one member rounds otherwise
            return torch.addcmul(bias, x, weight)
        return torch.baddbmm(bias, x, weight)

    def backward(
        self, weights: Weights, grads: Weights | None, kept: Tensor, grad: Tensor
    ) -> Tensor:
        """Go through the product."""
        weight = weights.weight[self.index]
        grad = grad.to(weight.dtype)
        if grads is not None:
            self.collect(grads, kept, grad)
        return grad * weight.mT if _is_slow(weight) else product(grad, weight.mT)

    def collect(self, grads: Weights, x: Tensor, grad: Tensor) -> None:
        """Overwrite the gradients of W and b; ``grad`` is in the precision of the product."""
        into = grads.weight[self.index]
        if grad.dtype != into.dtype:
            # To let the kernel write float32 costs a copy of what it reads.
            into.copy_(product(x.mT, grad))
        elif _is_slow(into):
            torch.sum(x * grad, dim=1, out=into.squeeze(2))
        else:
            product(x.mT, grad, into)
        if self.adds_bias:
            sum_rows(grad, grads.bias[self.index])


class Activation:
    """``max(x, 0)``, ``tanh(x)``, or silu, ``x / (1 + exp(-x))``.

    The memory of the layer below is written over, except by silu with a tape.
    """

    def __init__(self, kind: options.Activation) -> None:
        self.kind = kind

    def forward(self, _: Weights, x: Tensor, tape: list[Any] | None) -> Tensor:
        """Apply it to every number."""
        if self.kind == "silu":
            if tape is not None:
                tape.append(x)
                return F.silu(x)
            return F.silu(x, inplace=True)
        out = x.relu_() if self.kind == "relu" else x.tanh_()
        if tape is not None:
            tape.append(out)
        return out

    def backward(self, _: Weights, __: Weights | None, kept: Tensor, grad: Tensor) -> Tensor:
        """Multiply by the slope."""
        if self.kind == "relu":
            through: Tensor = _aten.threshold_backward(grad, kept, 0)
        elif self.kind == "silu":
            through = _aten.silu_backward(grad, kept)
        else:
            through = _aten.tanh_backward(grad, kept)
        return through


class Residual:
    """``x + f(x)``, where ``inner`` are the layers of f."""

    def __init__(self, inner: Sequence[Layer]) -> None:
        self.inner = inner

    def forward(self, weights: Weights, x: Tensor, tape: list[Any] | None) -> Tensor:
        """Add the output of the inner layers."""
        inside: list[Any] | None = None if tape is None else []
        out = run(self.inner, weights, x, inside).add_(x)
        if tape is not None:
            tape.append(inside)
        return out

    def backward(
        self, weights: Weights, grads: Weights | None, kept: list[Any], grad: Tensor
    ) -> Tensor:
        """Add the gradient through the inner layers to the gradient past them."""
        return run_back(self.inner, weights, grads, kept, grad).add_(grad)


def run(
    layers: Sequence[Layer], weights: Weights, x: Tensor, tape: list[Any] | None = None
) -> Tensor:
    """Go forward through layers."""
    for layer in layers:
        x = layer.forward(weights, x, tape)
    return x


def run_back(
    layers: Sequence[Layer],
    weights: Weights,
    grads: Weights | None,
    tape: list[Any],
    grad: Tensor,
) -> Tensor:
    """Go back through layers; returns the gradient by the input of the first."""
    for layer, kept in zip(reversed(layers), reversed(tape), strict=True):
        grad = layer.backward(weights, grads, kept, grad)
    return grad


def product(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """Multiply matrices of one network or of each member."""
    return torch.mm(a, b, out=out) if a.dim() == 2 else torch.bmm(a, b, out=out)


def _is_slow(weight: Tensor) -> bool:
    """Whether to multiply and add up: with one column a batched product takes five times as long.

    But in bfloat16 it adds up in float32.
    """
    return weight.dim() == 3 and weight.shape[2] == 1 and weight.dtype != torch.bfloat16


def sum_rows(x: Tensor, into: Tensor) -> None:
    """Overwrite ``into``, ``[E, 1, W]`` or ``[W]``, with the sums over the rows."""
    if x.dtype == into.dtype:
        torch.sum(x, -2, keepdim=into.dim() > 1, out=into)
    else:
        into.copy_(x.sum(-2, keepdim=into.dim() > 1))
