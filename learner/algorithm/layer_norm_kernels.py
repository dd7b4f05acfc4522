"""Layer normalisation and max(x, 0) in one pass over the rows, compiled (docs/adr/0007).

Rows are float32, or bfloat16 as uint16 with the same bits; everything is computed in float32.
"""

from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.extending import overload

from a2s.protocol.fields import Array

# Sums may be reordered, so that they are made eight and more at a time.
_compiled = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}
)
_F, _U = np.float32, np.uint32
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@_compiled  # type: ignore[untyped-decorator]
def forward(  # noqa: C901 - its loops are the branches
    x: Array, gain: Array, offset: Array, bias: Array, has_bias: bool, relu: bool, eps: float,
    out: Array, stats: Array,
) -> None:  # fmt: skip
    """Fill ``out [E, N, W]`` and ``stats [2, E, N]``: mean and one over the deviation.

    Args:
        x: ``[E, N, W]``.
        gain: ``[E, 1, W]``.
        offset: ``[E, 1, W]``.
        bias: Added before, ``[E, 1, W]``, if there is any.
        has_bias: Whether there is.
        relu: Whether to cut at 0.
        eps: Added to the variance.
        out: Written.
        stats: Written.
    """
    members, rows, width = x.shape
    bits = np.empty(width, _U)
    row = bits.view(_F)
    for e in range(members):
        for n in range(rows):
            _read(x, e, n, bits, row)
            if has_bias:
                for j in range(width):
                    row[j] += bias[e, 0, j]
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
                row[j] = (row[j] - mean) * rstd * gain[e, 0, j] + offset[e, 0, j]
            if relu:
                for j in range(width):
                    row[j] = row[j] if row[j] > _ZERO else _ZERO
            _write(out, e, n, bits, row)


@_compiled  # type: ignore[untyped-decorator]
def backward(  # noqa: C901 - its loops are the branches
    grad: Array, x: Array, out: Array, stats: Array, gain: Array, bias: Array, has_bias: bool,
    relu: bool, wanted: bool, by_input: Array, by_gain: Array, by_offset: Array, by_bias: Array,
) -> None:  # fmt: skip
    """Fill ``by_input [E, N, W]`` and, if wanted, the gradients by the parameters.

    Args:
        grad: By ``out``, ``[E, N, W]``.
        x: As given to `forward`.
        out: From `forward`.
        stats: From `forward`.
        gain: As given to `forward`.
        bias: As given to `forward`.
        has_bias: As given to `forward`.
        relu: As given to `forward`.
        wanted: Whether the last three are written, ``by_bias`` only if there is a bias.
        by_input: Written.
        by_gain: ``[E, 1, W]``.
        by_offset: ``[E, 1, W]``.
        by_bias: ``[E, 1, W]``.
    """
    members, rows, width = x.shape
    bits, grad_bits, out_bits = np.empty(width, _U), np.empty(width, _U), np.empty(width, _U)
    row, by_out, passed = bits.view(_F), grad_bits.view(_F), out_bits.view(_F)
    if wanted:
        by_gain[:] = _ZERO
        by_offset[:] = _ZERO
        if has_bias:
            by_bias[:] = _ZERO
    for e in range(members):
        for n in range(rows):
            mean, rstd = stats[0, e, n], stats[1, e, n]
            _read(x, e, n, bits, row)
            if has_bias:
                for j in range(width):
                    row[j] += bias[e, 0, j]
            _read(grad, e, n, grad_bits, by_out)
            if relu:
                _read(out, e, n, out_bits, passed)
                for j in range(width):
                    by_out[j] = by_out[j] if passed[j] > _ZERO else _ZERO
            along, across = _ZERO, _ZERO
            for j in range(width):
                normal = (row[j] - mean) * rstd
                scaled = by_out[j] * gain[e, 0, j]
                row[j] = normal
                across += scaled
                along += scaled * normal
            if wanted:
                for j in range(width):
                    by_gain[e, 0, j] += by_out[j] * row[j]
                for j in range(width):
                    by_offset[e, 0, j] += by_out[j]
            across /= _F(width)
            along /= _F(width)
            for j in range(width):
                row[j] = rstd * (by_out[j] * gain[e, 0, j] - across - row[j] * along)
            if wanted and has_bias:
                for j in range(width):
                    by_bias[e, 0, j] += row[j]
            _write(by_input, e, n, bits, row)


def _read(x: Array, e: int, n: int, bits: Any, row: Array) -> None:
    """Copy a row to ``row``, float32, whose memory is that of ``bits``, uint32."""


def _write(x: Array, e: int, n: int, bits: Any, row: Array) -> None:
    """Copy it back."""


@overload(_read)  # type: ignore[untyped-decorator]
def _reader(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
    def bfloat16(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
        for j in range(len(bits)):  # it is the upper half of a float32
            bits[j] = _U(x[e, n, j]) << _U(16)

    def float32(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
        for j in range(len(row)):
            row[j] = x[e, n, j]

    return bfloat16 if x.dtype == types.uint16 else float32


@overload(_write)  # type: ignore[untyped-decorator]
def _writer(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
    def bfloat16(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
        for j in range(len(bits)):  # to the nearest, and to the even one of two that are as near
            b = bits[j]
            x[e, n, j] = np.uint16((b + _U(0x7FFF) + ((b >> _U(16)) & _U(1))) >> _U(16))

    def float32(x: Any, e: Any, n: Any, bits: Any, row: Any) -> Any:
        for j in range(len(row)):
            x[e, n, j] = row[j]

    return bfloat16 if x.dtype == types.uint16 else float32
