"""Layer normalisation and x / (1 + exp(-x)) in one pass over the rows, compiled (docs/adr/0021).

As `kernels`, whose arguments these have; rows are float32.
"""

from typing import Any

import numpy as np

from a2s.learner.networks.kernels import as_float, compiled
from a2s.protocol.fields import Array

_F, _I, _U = np.float32, np.int32, np.uint32
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LOG2_E, _LN_2 = np.float32(1.442695041), np.float32(0.6931471806)
_MOST = np.float32(80.0)
# Taylor's of exp, from the sixth power down: 1.2e-7 of exp(f) for abs(f) < ln(2) / 2.
_C6, _C5, _C4, _C3 = (np.float32(1.0 / n) for n in (720, 120, 24, 6))


@compiled  # type: ignore[untyped-decorator]
def sigmoid(x: Any) -> Any:
    """``1 / (1 + exp(-x))`` of a float32, up to 3e-7; vectorised, as a call of exp is not."""
    y = min(max(-x, -_MOST), _MOST)
    scaled = y * _LOG2_E
    whole = _I(scaled + (_HALF if scaled >= _ZERO else -_HALF))
    f = y - _F(whole) * _LN_2
    power = _ONE + f * (_ONE + f * (_HALF + f * (_C3 + f * (_C4 + f * (_C5 + f * _C6)))))
    return _ONE / (_ONE + power * as_float(_U((whole + _I(127)) << _I(23))))


@compiled  # type: ignore[untyped-decorator]
def forward(
    x: Array, gain: Array, offset: Array, bias: Array, eps: float, out: Array, stats: Array
) -> None:
    """Fill ``out [E, N, W]`` and ``stats [2, E, N]``: mean and one over the deviation.

    ``bias`` is added before; it, gain and offset are ``[E, 1, W]``.
    """
    members, rows, width = x.shape
    row = np.empty(width, _F)
    for e in range(members):
        for n in range(rows):
            for j in range(width):
                row[j] = x[e, n, j] + bias[e, 0, j]
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
                out[e, n, j] = affine * sigmoid(affine)


@compiled  # type: ignore[untyped-decorator]
def backward(  # noqa: C901 - loops
    grad: Array, x: Array, stats: Array, gain: Array, offset: Array, bias: Array, wanted: bool,
    by_input: Array, by_gain: Array, by_offset: Array, by_bias: Array,
) -> None:  # fmt: skip
    """Fill ``by_input [E, N, W]`` and, if wanted, the gradients by the parameters.

    ``grad`` is the gradient by what `forward` gave.
    """
    members, rows, width = x.shape
    row, by_out = np.empty(width, _F), np.empty(width, _F)
    if wanted:
        by_gain[:] = _ZERO
        by_offset[:] = _ZERO
        by_bias[:] = _ZERO
    for e in range(members):
        for n in range(rows):
            mean, rstd = stats[0, e, n], stats[1, e, n]
            along, across = _ZERO, _ZERO
            for j in range(width):
                row[j] = (x[e, n, j] + bias[e, 0, j] - mean) * rstd
            for j in range(width):
                affine = row[j] * gain[e, 0, j] + offset[e, 0, j]
                part = sigmoid(affine)
                by_out[j] = grad[e, n, j] * part * (_ONE + affine * (_ONE - part))
            for j in range(width):
                scaled = by_out[j] * gain[e, 0, j]
                across += scaled
                along += scaled * row[j]
            across /= _F(width)
            along /= _F(width)
            for j in range(width):
                made = rstd * (by_out[j] * gain[e, 0, j] - across - row[j] * along)
                by_input[e, n, j] = made
            if wanted:
                for j in range(width):
                    by_gain[e, 0, j] += by_out[j] * row[j]
                    by_offset[e, 0, j] += by_out[j]
                    by_bias[e, 0, j] += by_input[e, n, j]
