"""Layer normalisation with gain and offset, and its gradient.

In relu networks on a CPU compiled kernels make it in one pass, with the bias before and the cut at
0 after it (docs/adr/0007); elsewhere, and in float64, torch's kernels do. torch's own gradient by
gain and offset is not used: it takes one member at a time.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from a2s.protocol.fields import Array

LAYER_NORM_EPS = 1e-5
_aten = torch.ops.aten


@dataclasses.dataclass(frozen=True)
class Affine:
    """Parameters or their gradients, ``[E, 1, W]`` or ``[W]``; ``bias`` is added before."""

    gain: Tensor
    offset: Tensor
    bias: Tensor | None

    @functools.cached_property
    def arrays(self) -> tuple[Array, Array, Array]:
        """All three in the same memory; where there is no bias the gain, which nothing reads."""
        gain = self.gain.numpy()
        return gain, self.offset.numpy(), gain if self.bias is None else self.bias.numpy()

    def pick(self, members: Tensor) -> "Affine":
        """Those of some members, gathered."""
        bias = None if self.bias is None else self.bias.index_select(0, members)
        gain, offset = (each.index_select(0, members) for each in (self.gain, self.offset))
        return Affine(gain, offset, bias)


class _Compiled(NamedTuple):
    """Input, output and ``[2, E, N]``, mean and one over the deviation: what the kernels keep."""

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


def layer_norm(
    x: Tensor, affine: Affine, *, relu: bool, compiled: bool, tape: list[Any] | None
) -> Tensor:
    """Normalise over the last dimension.

    Args:
        x: ``[E, N, W]``, or ``[N, W]``, of any precision.
        affine: Parameters, float32 unless x is float64.
        relu: Whether to cut at 0.
        compiled: Whether the kernels may do it; they take ``[E, N, W]`` on a CPU.
        tape: Is given what `layer_norm_back` needs.
    """
    x = x.contiguous()
    gain, offset, bias = affine.gain, affine.offset, affine.bias
    if compiled and x.dim() == 3 and x.is_cpu and x.dtype != torch.float64:
        out = torch.empty_like(x)
        kept = _Compiled(_raw(x), _raw(out), gain.new_empty(2, *x.shape[:2]).numpy())
        has_bias = bias is not None
        _kernels().forward(kept.x, *affine.arrays, has_bias, relu, LAYER_NORM_EPS, *kept[1:])
        if tape is not None:
            tape.append(kept)
        return out
    rows = x.to(gain.dtype) if bias is None else x.to(gain.dtype) + bias
    width = rows.shape[-1:]
    if tape is None and gain.dim() == 1 and not relu:
        return F.layer_norm(rows, width, gain, offset, LAYER_NORM_EPS)
    normal, mean, rstd = torch.native_layer_norm(rows, width, None, None, LAYER_NORM_EPS)
    out = torch.addcmul(offset, normal, gain)
    out = (out.relu_() if relu else out).to(x.dtype)
    if tape is not None:
        tape.append(_Normed(rows, normal, mean, rstd, out))
    return out


def layer_norm_back(
    kept: _Compiled | _Normed, grad: Tensor, affine: Affine, *, relu: bool, into: Affine | None
) -> Tensor:
    """Turn the gradient by the output into that by the input, both as precise as the input.

    The gradients by the parameters are written ``into``; ``None``: they are not wanted.
    """
    if isinstance(kept, _Compiled):
        grad = grad.contiguous()
        into_x = torch.empty_like(grad)
        gain, _, bias = affine.arrays
        _kernels().backward(
            _raw(grad), *kept, gain, bias, affine.bias is not None, relu,
            into is not None, _raw(into_x), *(into or affine).arrays,
        )  # fmt: skip
        return into_x
    if relu:
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


def sum_rows(x: Tensor, into: Tensor) -> None:
    """Overwrite ``into``, ``[E, 1, W]`` or ``[W]``, with the sums over the rows."""
    if x.dtype == into.dtype:
        torch.sum(x, -2, keepdim=into.dim() > 1, out=into)
    else:
        into.copy_(x.sum(-2, keepdim=into.dim() > 1))


@functools.cache
def _kernels() -> Any:
    from a2s.learner.networks import kernels  # half a second: only who needs it

    return kernels


def _raw(x: Tensor) -> Array:
    """The same memory as an array; bfloat16, which numpy does not know, as its bits."""
    return (x.view(torch.uint16) if x.dtype == torch.bfloat16 else x).numpy()
