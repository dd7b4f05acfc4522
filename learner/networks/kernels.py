"""Layer normalisation and max(x, 0) in one pass over the rows, compiled (docs/adr/0007).

Rows are float32, or bfloat16 as uint16 with the same bits; everything is computed in float32.
"""

from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.extending import intrinsic, overload

from a2s.protocol.fields import Array

# Sums may be reordered, so that they are made eight and more at a time. A loop that adds up stores
# nothing: else it is made one by one, in another order, where arrays happen to lie close together.
compiled = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}
)
_F, _U = np.float32, np.uint32
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@compiled  # type: ignore[untyped-decorator]
def forward(
    x: Array, gain: Array, offset: Array, bias: Array, has_bias: bool, relu: bool, eps: float,
    out: Array, stats: Array,
) -> None:  # fmt: skip
    """Fill ``out [E, N, W]`` and ``stats [2, E, N]``: mean and one over the deviation.

    ``bias`` is added before; it, gain and offset are ``[E, 1, W]``.
    """
    members, rows, width = x.shape
    row, shift = np.empty(width, _F), np.zeros(width, _F)
    least = _ZERO if relu else _F(-np.inf)
    for e in range(members):
        if has_bias:
            shift[:] = bias[e, 0]
        for n in range(rows):
            for j in range(width):
                row[j] = _read(x, e, n, j) + shift[j]
            mean = _ZERO
            for j in range(width):
                mean += row[j]
            mean /= _F(width)
            squares = _ZERO
            for j in range(width):
                centred = row[j] - mean
                squares += centred * centred
            rstd = _ONE / np.sqrt(squares / _F(width) + _F(eps))
            stats[0, e, n], stats[1, e, n] = mean, rstd
            for j in range(width):
                affine = (row[j] - mean) * rstd * gain[e, 0, j] + offset[e, 0, j]
                _write(out, e, n, j, least if affine < least else affine)


@compiled  # type: ignore[untyped-decorator]
def backward(grad: Array, x: Array, out: Array, stats: Array, gain: Array,  # noqa: C901 - loops
    bias: Array, has_bias: bool, relu: bool, wanted: bool, by_input: Array, by_gain: Array,
    by_offset: Array, by_bias: Array) -> None:  # fmt: skip
    """Fill ``by_input [E, N, W]`` and, if wanted, the gradients by the parameters.

    ``grad`` is the gradient by ``out``. ``by_bias`` is written only if there is a bias.
    """
    members, rows, width = x.shape
    row, by_out, shift = np.empty(width, _F), np.empty(width, _F), np.zeros(width, _F)
    by_shift = np.empty(width, _F)
    least = _ZERO if relu else _F(-np.inf)
    if wanted:
        by_gain[:] = _ZERO
        by_offset[:] = _ZERO
    for e in range(members):
        by_shift[:] = _ZERO
        if has_bias:
            shift[:] = bias[e, 0]
        for n in range(rows):
            mean, rstd = stats[0, e, n], stats[1, e, n]
            along, across = _ZERO, _ZERO
            for j in range(width):
                through = _read(grad, e, n, j)
                by_out[j] = _ZERO if _read(out, e, n, j) <= least else through
                row[j] = (_read(x, e, n, j) + shift[j] - mean) * rstd
            for j in range(width):
                scaled = by_out[j] * gain[e, 0, j]
                across += scaled
                along += scaled * row[j]
            across /= _F(width)
            along /= _F(width)
            if not wanted:
                for j in range(width):
                    scaled = by_out[j] * gain[e, 0, j]
                    _write(by_input, e, n, j, rstd * (scaled - across - row[j] * along))
                continue
            for j in range(width):
                by_gain[e, 0, j] += by_out[j] * row[j]
                by_offset[e, 0, j] += by_out[j]
                made = rstd * (by_out[j] * gain[e, 0, j] - across - row[j] * along)
                by_shift[j] += made
                _write(by_input, e, n, j, made)
        if wanted and has_bias:
            by_bias[e, 0] = by_shift


def _read(x: Array, e: int, n: int, j: int) -> Any:
    """Give a number of a row as float32."""


def _write(x: Array, e: int, n: int, j: int, value: Any) -> None:
    """Put a float32 back."""


@overload(_read, inline="always")  # type: ignore[untyped-decorator]
def _reader(x: Any, e: Any, n: Any, j: Any) -> Any:
    def bfloat16(x: Any, e: Any, n: Any, j: Any) -> Any:
        return as_float(_U(x[e, n, j]) << _U(16))  # it is the upper half of a float32

    def float32(x: Any, e: Any, n: Any, j: Any) -> Any:
        return x[e, n, j]

    return bfloat16 if x.dtype == types.uint16 else float32


@overload(_write, inline="always")  # type: ignore[untyped-decorator]
def _writer(x: Any, e: Any, n: Any, j: Any, value: Any) -> Any:
    def bfloat16(x: Any, e: Any, n: Any, j: Any, value: Any) -> Any:
        b = _as_bits(value)  # to the nearest, and to the even one of two that are as near
        x[e, n, j] = np.uint16((b + _U(0x7FFF) + ((b >> _U(16)) & _U(1))) >> _U(16))

    def float32(x: Any, e: Any, n: Any, j: Any, value: Any) -> Any:
        x[e, n, j] = value

    return bfloat16 if x.dtype == types.uint16 else float32


@intrinsic  # type: ignore[untyped-decorator]
def as_float(_: Any, __: Any) -> Any:
    """Read 32 bits as a number."""
    return types.float32(types.uint32), _same_bits


@intrinsic  # type: ignore[untyped-decorator]
def _as_bits(_: Any, __: Any) -> Any:
    """Read a number as its 32 bits."""
    return types.uint32(types.float32), _same_bits


def _same_bits(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))
