"""The layers of a network that is evaluated by several members at once, forward and backward.

Each layer knows where its parameters are in `Weights`, maps float32 ``[E, N, in]`` to
``[E, N, out]`` and remembers what its gradient needs. Matrix products run in the precision of the
weights they are given, everything around them in float32.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

LAYER_NORM_EPS = 1e-5
_aten = torch.ops.aten


class Weights(NamedTuple):
    """The parameters of E members, each ``[E, rows, columns]``, by number.

    Attributes:
        full: In float32.
        product: The same in the precision of matrix products.
    """

    full: list[Tensor]
    product: list[Tensor]


class Layer(Protocol):
    """One step of a network and its gradient."""

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Any]:
        """Map ``[E, N, in]`` to ``[E, N, out]``, and give what `backward` needs."""

    def backward(
        self, weights: Weights, grads: list[Tensor] | None, seen: Any, grad: Tensor
    ) -> Tensor:
        """Turn the gradient by the output into that by the input.

        Args:
            weights: As in `forward`.
            grads: Gradients of the parameters, float32, to be overwritten; ``None``: not wanted.
            seen: From `forward`.
            grad: ``[E, N, out]``; may be overwritten.
        """


class Linear:
    """``x W + b``.

    Args:
        weight: Number of W, ``[E, in, out]``.
        bias: Number of b, ``[E, 1, out]``.
    """

    def __init__(self, weight: int, bias: int) -> None:
        self.weight = weight
        self.bias = bias

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Multiply and add."""
        weight, bias = weights.product[self.weight], weights.full[self.bias]
        if weight.dtype == x.dtype:
            return torch.baddbmm(bias, x, weight), x
        x = x.to(weight.dtype)
        return torch.bmm(x, weight) + bias, x

    def backward(
        self, weights: Weights, grads: list[Tensor] | None, seen: Tensor, grad: Tensor
    ) -> Tensor:
        """Go through the product."""
        weight = weights.product[self.weight]
        by_output = grad.to(weight.dtype)
        if grads is not None:
            self.collect(grads, seen, grad, by_output)
        return torch.bmm(by_output, weight.mT).to(grad.dtype)

    def collect(self, grads: list[Tensor], seen: Tensor, grad: Tensor, by_output: Tensor) -> None:
        """Overwrite the gradients of W and b."""
        torch.sum(grad, 1, keepdim=True, out=grads[self.bias])
        if by_output.dtype == grad.dtype:
            torch.bmm(seen.mT, by_output, out=grads[self.weight])
        else:
            grads[self.weight].copy_(torch.bmm(seen.mT, by_output))


class Relu:
    """``max(x, 0)``, without parameters."""

    def forward(self, _: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Cut at 0."""
        x = torch.relu(x)
        return x, x

    def backward(self, _: Weights, __: list[Tensor] | None, seen: Tensor, grad: Tensor) -> Tensor:
        """Let through what was above 0."""
        through: Tensor = _aten.threshold_backward(grad, seen, 0)
        return through


class Norm:
    """Layer normalisation with gain and offset.

    Member by member: the kernel takes one gain, and is so twice as fast as one without and two
    more for gain and offset.

    Args:
        gain: Number of the gain, ``[E, 1, width]``.
        offset: Number of the offset, ``[E, 1, width]``.
    """

    def __init__(self, gain: int, offset: int) -> None:
        self.gain = gain
        self.offset = offset

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Any]:
        """Normalise over the last dimension."""
        out = torch.empty_like(x)
        moments = []
        for member, rows in enumerate(x):
            gain, offset = weights.full[self.gain][member], weights.full[self.offset][member]
            normal, mean, rstd = torch.native_layer_norm(
                rows, rows.shape[-1:], gain.view(-1), offset.view(-1), LAYER_NORM_EPS
            )
            out[member] = normal
            moments.append((mean, rstd))
        return out, (x, moments)

    def backward(
        self, weights: Weights, grads: list[Tensor] | None, seen: Any, grad: Tensor
    ) -> Tensor:
        """Go through the normalisation."""
        x, moments = seen
        through = torch.empty_like(grad)
        wanted = grads is not None
        for member, (mean, rstd) in enumerate(moments):
            rows = x[member]
            gain, offset = weights.full[self.gain][member], weights.full[self.offset][member]
            by_input, by_gain, by_offset = _aten.native_layer_norm_backward(
                grad[member],
                rows,
                rows.shape[-1:],
                mean,
                rstd,
                gain.view(-1),
                offset.view(-1),
                [True, wanted, wanted],
            )
            through[member] = by_input
            if grads is not None:
                grads[self.gain][member, 0] = by_gain
                grads[self.offset][member, 0] = by_offset
        return through


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
        return inside + x, tape

    def backward(
        self, weights: Weights, grads: list[Tensor] | None, seen: list[Any], grad: Tensor
    ) -> Tensor:
        """Add what comes through the inner layers to what goes past them."""
        return run_back(self.inner, weights, grads, seen, grad) + grad


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
    grads: list[Tensor] | None,
    tape: list[Any],
    grad: Tensor,
) -> Tensor:
    """Go back through layers; returns the gradient by the input of the first."""
    for layer, seen in zip(reversed(layers), reversed(tape), strict=True):
        grad = layer.backward(weights, grads, seen, grad)
    return grad
