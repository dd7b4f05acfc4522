"""Layer normalisation with gain and offset, and its gradient.

In relu networks on a CPU compiled kernels make it in one pass, with the bias before and the cut at
0 after it (docs/adr/0007); elsewhere, and in float64, torch's kernels do. torch's own gradient by
gain and offset is not used: it takes one member at a time.
"""

import functools
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from a2s.learner.networks.layers import sum_rows
from a2s.learner.networks.weights import Weights
from a2s.protocol.fields import Array

LAYER_NORM_EPS = 1e-5
_aten = torch.ops.aten


class _Compiled(NamedTuple):
    """What the kernels keep: input, output, and mean and one over the deviation, ``[2, E, N]``."""

    x: Array
    out: Array
    stats: Array


class _Normed(NamedTuple):
    """What torch's kernels keep; ``normal`` lacks gain and offset."""

    x: Tensor
    normal: Tensor
    mean: Tensor
    rstd: Tensor
    out: Tensor


class Norm:
    """Layer normalisation over the last dimension, with the gain and offset number ``index``.

    ``bias`` is the number of the bias that the Linear below leaves to this layer, if it does. With
    ``relu`` it cuts at 0. ``compiled`` allows the kernels, which need members, a CPU, no float64.
    """

    def __init__(
        self, index: int, *, bias: int | None = None, relu: bool = False, compiled: bool
    ) -> None:
        self.index = index
        self.bias = bias
        self.relu = relu
        self.compiled = compiled

    def forward(self, weights: Weights, x: Tensor, tape: list[Any] | None) -> Tensor:
        """Normalise, ``[E, N, W]`` or ``[N, W]``, of any precision."""
        affine, x = weights.norms[self.index], x.contiguous()
        if self.compiled and x.dim() == 3 and x.is_cpu and x.dtype != torch.float64:
            out, stats = torch.empty_like(x), affine.gain.new_empty(2, *x.shape[:2])
            kept = _Compiled(_raw(x), _raw(out), stats.numpy())
            has_bias = affine.bias is not None
            _kernels().forward(
                kept.x, *affine.arrays, has_bias, self.relu, LAYER_NORM_EPS, kept.out, kept.stats
            )
            if tape is not None:
                tape.append(kept)
            return out
        rows = x.to(affine.gain.dtype)
        if affine.bias is not None:
            rows = rows + affine.bias
        width = rows.shape[-1:]
        if tape is None and x.dim() == 2 and not self.relu:
            return F.layer_norm(rows, width, affine.gain, affine.offset, LAYER_NORM_EPS)
        normal, mean, rstd = torch.native_layer_norm(rows, width, None, None, LAYER_NORM_EPS)
        out = torch.addcmul(affine.offset, normal, affine.gain)
        out = (out.relu_() if self.relu else out).to(x.dtype)
        if tape is not None:
            tape.append(_Normed(rows, normal, mean, rstd, out))
        return out

    def backward(
        self, weights: Weights, grads: Weights | None, kept: _Compiled | _Normed, grad: Tensor
    ) -> Tensor:
        """Go through the normalisation; the precision stays."""
        affine = weights.norms[self.index]
        into = None if grads is None else grads.norms[self.index]
        if isinstance(kept, _Compiled):
            grad = grad.contiguous()
            into_x = torch.empty_like(grad)
            gain, _, bias = affine.arrays
            _kernels().backward(
                _raw(grad), *kept, gain, bias, affine.bias is not None, self.relu,
                into is not None, _raw(into_x), *(into or affine).arrays,
            )  # fmt: skip
            return into_x
        if self.relu:
            grad = _aten.threshold_backward(grad, kept.out, 0)
        kind, grad = grad.dtype, grad.to(affine.gain.dtype)
        if into is not None:
            sum_rows(grad * kept.normal, into.gain)
            sum_rows(grad, into.offset)
        through: Tensor = _aten.native_layer_norm_backward(
            grad * affine.gain, kept.x, grad.shape[-1:], kept.mean, kept.rstd, None, None,
            [True, False, False],
        )[0]  # fmt: skip
        if into is not None and into.bias is not None:
            sum_rows(through, into.bias)
        return through.to(kind)


@functools.cache
def _kernels() -> Any:
    from a2s.learner.networks import kernels  # half a second: only who needs it

    return kernels


def _raw(x: Tensor) -> Array:
    """The same memory as an array; bfloat16, which numpy does not know, as its bits."""
    return (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()
