"""The layers of a network that is evaluated by several members at once, forward and backward.

Each layer knows where its parameters are in `Weights`, maps ``[E, N, in]`` to ``[E, N, out]`` and
remembers what its gradient needs. Everything is in the precision of the weights that are given;
normalisation adds up in float32, and its gain and offset are float32.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

LAYER_NORM_EPS = 1e-5
_aten = torch.ops.aten


class Weights(NamedTuple):
    """The parameters of E members, or their gradients, by number.

    Attributes:
        full: Each ``[E, rows, columns]``, float32.
        product: The same in the precision of matrix products.
        vectors: Of each with one row, the members one by one, float32 ``[columns]``: finding them
            takes as long as a small kernel.
    """

    full: list[Tensor]
    product: list[Tensor]
    vectors: list[list[Tensor]]


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
    """

    def __init__(self, weight: int, bias: int) -> None:
        self.weight = weight
        self.bias = bias

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Multiply and add."""
        weight, bias = weights.product[self.weight], weights.product[self.bias]
        x = x.to(weight.dtype)
        return torch.baddbmm(bias, x, weight), x

    def backward(
        self, weights: Weights, grads: Weights | None, seen: Tensor, grad: Tensor
    ) -> Tensor:
        """Go through the product."""
        weight = weights.product[self.weight]
        grad = grad.to(weight.dtype)
        if grads is not None:
            self.collect(grads, seen, grad)
        return torch.bmm(grad, weight.mT)

    def collect(self, grads: Weights, seen: Tensor, grad: Tensor) -> None:
        """Overwrite the gradients of W and b; ``grad`` is in the precision of the product."""
        by_weight, by_bias = grads.full[self.weight], grads.full[self.bias]
        if grad.dtype == by_weight.dtype:
            torch.bmm(seen.mT, grad, out=by_weight)
            torch.sum(grad, 1, keepdim=True, out=by_bias)
        else:  # to let the kernels write float32 costs a copy of what they read
            by_weight.copy_(torch.bmm(seen.mT, grad))
            by_bias.copy_(grad.sum(1, keepdim=True))


class Relu:
    """``max(x, 0)``, without parameters."""

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Tensor]:
        """Cut at 0."""
        x = torch.relu(x)
        return x, x

    def backward(self, _: Weights, __: Weights | None, seen: Tensor, grad: Tensor) -> Tensor:
        """Let through what was above 0."""
        return _above_zero(grad, seen)


class Norm:
    """Layer normalisation with gain and offset, and max(x, 0) where wanted.

    Member by member: the kernel takes one gain, and is so faster than one without and two more
    for gain and offset.

    Args:
        gain: Number of the gain, ``[E, 1, width]``.
        offset: Number of the offset, ``[E, 1, width]``.
        relu: Whether to cut at 0.
    """

    def __init__(self, gain: int, offset: int, *, relu: bool) -> None:
        self.gain = gain
        self.offset = offset
        self.relu = relu

    def forward(self, weights: Weights, x: Tensor) -> tuple[Tensor, Any]:
        """Normalise over the last dimension."""
        made, tape = [], []
        for rows, gain, offset in zip(x.unbind(0), *self._vectors(weights), strict=True):
            normal, mean, rstd = torch.native_layer_norm(
                rows, gain.shape, gain, offset, LAYER_NORM_EPS
            )
            made.append(normal.relu_() if self.relu else normal)
            tape.append((rows, mean, rstd))
        out = _together(made)
        return out, (out, tape)

    def backward(self, weights: Weights, grads: Weights | None, seen: Any, grad: Tensor) -> Tensor:
        """Go through the normalisation."""
        out, tape = seen
        if self.relu:
            grad = _above_zero(grad, out)
        wanted = grads is not None
        parts = (tape, grad.unbind(0), *self._vectors(weights))
        through, found = [], []
        for (rows, mean, rstd), by_out, gain, offset in zip(*parts, strict=True):
            by_input, by_gain, by_offset = _aten.native_layer_norm_backward(
                by_out, rows, gain.shape, mean, rstd, gain, offset, [True, wanted, wanted]
            )
            through.append(by_input)
            found.append((by_gain, by_offset))
        if grads is not None:
            for each, gain, offset in zip(found, *self._vectors(grads), strict=True):
                gain.copy_(each[0])
                offset.copy_(each[1])
        return _together(through)

    def _vectors(self, weights: Weights) -> tuple[list[Tensor], list[Tensor]]:
        return weights.vectors[self.gain], weights.vectors[self.offset]


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
        self, weights: Weights, grads: Weights | None, seen: list[Any], grad: Tensor
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
    grads: Weights | None,
    tape: list[Any],
    grad: Tensor,
) -> Tensor:
    """Go back through layers; returns the gradient by the input of the first."""
    for layer, seen in zip(reversed(layers), reversed(tape), strict=True):
        grad = layer.backward(weights, grads, seen, grad)
    return grad


def _together(members: list[Tensor]) -> Tensor:
    """Stack members; one alone is not copied."""
    return torch.stack(members) if len(members) > 1 else members[0].unsqueeze(0)


def _above_zero(grad: Tensor, out: Tensor) -> Tensor:
    through: Tensor = _aten.threshold_backward(grad, out, 0)
    return through
