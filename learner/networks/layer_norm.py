"""Layer normalisation of several members' rows, with gain, offset and max(x, 0), and its gradient.

On a processor compiled kernels make it in one pass (docs/adr/0007); elsewhere, and in float64,
torch's do.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from a2s.protocol.fields import Array

LAYER_NORM_EPS = 1e-5
_aten = torch.ops.aten


@dataclasses.dataclass(frozen=True)
class Affine:
    """Parameters, or the gradients by them: float32 unless what is normalised is float64.

    Args:
        gain: ``[E, 1, W]``.
        offset: ``[E, 1, W]``.
        bias: Added before normalisation, ``[E, 1, W]``, or ``None``.
    """

    gain: Tensor
    offset: Tensor
    bias: Tensor | None

    @functools.cached_property
    def arrays(self) -> tuple[Array, Array, Array]:
        """All three in the same memory; where there is no bias the gain, which nothing reads."""
        gain = self.gain.numpy()
        return gain, self.offset.numpy(), gain if self.bias is None else self.bias.numpy()


class Normed(NamedTuple):
    """What the gradient needs of one pass.

    Attributes:
        x: What was given, ``[E, N, W]``.
        out: What came out, ``[E, N, W]``.
        stats: Mean of each row, and one over its standard deviation, ``[2, E, N]``.
        arrays: The same three as arrays, if the kernels made them.
    """

    x: Tensor
    out: Tensor
    stats: Tensor
    arrays: tuple[Array, Array, Array] | None


def layer_norm(x: Tensor, affine: Affine, *, relu: bool) -> Normed:
    """Normalise over the last dimension.

    Args:
        x: ``[E, N, W]``, of any precision.
        affine: Parameters.
        relu: Whether to cut at 0.
    """
    x = x.contiguous()
    if _is_compiled(x):
        out, stats = torch.empty_like(x), affine.gain.new_empty(2, *x.shape[:2])
        arrays = _raw(x), _raw(out), stats.numpy()
        has_bias = affine.bias is not None
        _kernels().forward(arrays[0], *affine.arrays, has_bias, relu, LAYER_NORM_EPS, *arrays[1:])
        return Normed(x, out, stats, arrays)
    made = [
        torch.native_layer_norm(rows, rows.shape[-1:], gain[0], offset[0], LAYER_NORM_EPS)
        for rows, gain, offset in zip(_biased(x, affine), affine.gain, affine.offset, strict=True)
    ]
    out, mean, rstd = (torch.stack(part) for part in zip(*made, strict=True))
    out = (out.relu_() if relu else out).to(x.dtype)
    return Normed(x, out, torch.stack([mean, rstd]).squeeze(-1), None)


def layer_norm_back(
    normed: Normed, grad: Tensor, affine: Affine, *, relu: bool, into: Affine | None
) -> Tensor:
    """Turn the gradient by the output, ``[E, N, W]``, into that by the input.

    Args:
        normed: From `layer_norm`.
        grad: ``[E, N, W]``, as precise as the input.
        affine: As given to `layer_norm`.
        relu: As given to `layer_norm`.
        into: Where the gradients by the parameters are written; ``None``: they are not wanted.
    """
    grad = grad.contiguous()
    if normed.arrays is not None:
        through = torch.empty_like(grad)
        gain, _, bias = affine.arrays
        _kernels().backward(
            _raw(grad), *normed.arrays, gain, bias, affine.bias is not None, relu,
            into is not None, _raw(through), *(into or affine).arrays,
        )  # fmt: skip
        return through
    if relu:
        grad = _aten.threshold_backward(grad, normed.out, 0)
    mean, rstd = normed.stats.unsqueeze(-1)
    parts = (grad.to(mean.dtype), _biased(normed.x, affine), mean, rstd, affine.gain)
    made = [
        _aten.native_layer_norm_backward(
            by_out, rows, rows.shape[-1:], m, r, gain[0], gain[0], [True, True, True]
        )
        for by_out, rows, m, r, gain in zip(*parts, strict=True)
    ]
    through, by_gain, by_offset = (torch.stack(part) for part in zip(*made, strict=True))
    if into is not None:
        into.gain.copy_(by_gain.unsqueeze(1))
        into.offset.copy_(by_offset.unsqueeze(1))
        if into.bias is not None:
            into.bias.copy_(through.sum(1, keepdim=True))
    return through.to(grad.dtype)


def _biased(x: Tensor, affine: Affine) -> Tensor:
    x = x.to(affine.gain.dtype)
    return x if affine.bias is None else x + affine.bias


@functools.cache
def _kernels() -> Any:
    from a2s.learner.networks import kernels  # half a second: only who needs it

    return kernels


def _is_compiled(x: Tensor) -> bool:
    return x.is_cpu and x.dtype != torch.float64


def _raw(x: Tensor) -> Array:
    """The same memory as an array; bfloat16, which numpy does not know, as its bits."""
    return (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()
