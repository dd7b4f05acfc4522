"""A gradient step of one small network without a call of torch, compiled (docs/adr/0022).

A network is Linear, layer normalisation (or none) and silu or tanh, as often as it has hidden
layers, and a Linear. Its parameters, gradients and moments of Adam are float32 vectors; where each
layer's are in them is said by ``layout``, int64 ``[layers, 7]`` of `Form.layout`. The products are
BLAS's, by way of SciPy.
"""

from typing import Any, NamedTuple

import numpy as np

from a2s.learner.networks.adam import BETA_1, BETA_2, EPS
from a2s.learner.networks.kernels import as_float, compiled
from a2s.learner.networks.layer_norm import LAYER_NORM_EPS
from a2s.learner.networks.weights import BIAS, COLUMNS, GAIN, OFFSET, ROWS, SILU, WEIGHT
from a2s.protocol.fields import Array

_F, _I, _U = np.float32, np.int32, np.uint32
_ZERO, _HALF, _ONE, _TWO = (np.float32(n) for n in (0.0, 0.5, 1.0, 2.0))
_LOG2_E, _LN_2, _MOST = np.float32(1.442695041), np.float32(0.6931471806), np.float32(80.0)
# Taylor's of exp, from the sixth power down: 1.2e-7 of exp(f) for abs(f) < ln(2) / 2.
_C6, _C5, _C4, _C3 = (np.float32(1.0 / n) for n in (720, 120, 24, 6))
_B1, _B2, _EPS = np.float32(1 - BETA_1), np.float32(BETA_2), np.float32(EPS)
_LAYER_NORM_EPS = np.float32(LAYER_NORM_EPS)


class Memory(NamedTuple):
    """What a pass of at most M rows keeps: of every layer, flat, as wide as the widest."""

    before: Array  # the activation: normalised where there is a normalisation, [L, M W]
    after: Array  # the activation, [L, M W]
    slope: Array  # of the activation, [L, M W]
    rstd: Array  # one over the deviation of a row, [L, M]
    down: Array  # gradients by the outputs of odd and of even layers, [2, M W]


@compiled  # type: ignore[untyped-decorator]
def memory(layout: Array, rows: int) -> Any:
    """Room for passes of so many rows."""
    layers, width = len(layout), 1
    for layer in range(layers):
        width = max(width, layout[layer, COLUMNS])
    size = rows * width
    return Memory(
        np.empty((layers, size), _F), np.empty((layers, size), _F), np.empty((layers, size), _F),
        np.empty((layers, rows), _F), np.empty((2, size), _F),
    )  # fmt: skip


@compiled  # type: ignore[untyped-decorator]
def forward(value: Array, layout: Array, x: Array, mem: Any) -> Any:
    """Map inputs ``[M, in]`` to outputs ``[M, out]``, a view of the memory."""
    at = layout[0]
    weight = matrix(value, at[WEIGHT], at[ROWS], at[COLUMNS])
    np.dot(x, weight, matrix(mem.before[0], 0, len(x), at[COLUMNS]))
    return above_first(value, layout, len(x), mem)


@compiled  # type: ignore[untyped-decorator]
def evaluate(value: Array, layout: Array, x: Array, room: int, into: Array) -> None:
    """Fill ``into [N, out]`` with the outputs for ``x [N, in]``, ``room`` rows at a time."""
    mem = memory(layout, room)
    for start in range(0, len(x), room):
        into[start : start + room] = forward(value, layout, x[start : start + room], mem)


@compiled  # type: ignore[untyped-decorator]
def above_first(value: Array, layout: Array, rows: int, mem: Any) -> Any:
    """The rest of `forward`, from the first product, which is in the memory already."""
    for layer in range(len(layout) - 1):
        at, over = layout[layer], layout[layer + 1]
        width = at[COLUMNS]
        before, after, slope = (
            matrix(mem.before[layer], 0, rows, width), matrix(mem.after[layer], 0, rows, width),
            matrix(mem.slope[layer], 0, rows, width),
        )  # fmt: skip
        bias = vector(value, at[BIAS], width)
        if at[GAIN] < 0:
            _activate(before, bias, at[SILU], after, slope)
        else:
            _normalise(
                before, bias, vector(value, at[GAIN], width), vector(value, at[OFFSET], width),
                at[SILU], after, slope, mem.rstd[layer],
            )  # fmt: skip
        weight = matrix(value, over[WEIGHT], width, over[COLUMNS])
        np.dot(after, weight, matrix(mem.before[layer + 1], 0, rows, over[COLUMNS]))
    at = layout[-1]
    out = matrix(mem.before[len(layout) - 1], 0, rows, at[COLUMNS])
    bias = vector(value, at[BIAS], at[COLUMNS])
    for n in range(rows):
        add(out[n], bias)
    return out


@compiled  # type: ignore[untyped-decorator]
def backward(value: Array, grad: Array, layout: Array, x: Array, mem: Any, by_out: Array) -> None:
    """Overwrite the network's gradients; ``by_out [M, out]`` is the gradient by its outputs.

    ``mem`` is as `forward` left it for ``x``.
    """
    rows, down = len(x), by_out
    _sum_rows(down, vector(grad, layout[-1, BIAS], layout[-1, COLUMNS]))
    for layer in range(len(layout) - 1, -1, -1):
        at = layout[layer]
        width = at[ROWS]
        into = matrix(grad, at[WEIGHT], width, at[COLUMNS])
        if layer == 0:
            np.dot(x.T, down, into)
            break
        below = layout[layer - 1]
        np.dot(matrix(mem.after[layer - 1], 0, rows, width).T, down, into)
        through = matrix(mem.down[layer % 2], 0, rows, width)
        np.dot(down, matrix(value, at[WEIGHT], width, at[COLUMNS]).T, through)
        slope = matrix(mem.slope[layer - 1], 0, rows, width)
        for n in range(rows):
            _multiply(through[n], slope[n])
        if below[GAIN] >= 0:
            _through_norm(
                through, matrix(mem.before[layer - 1], 0, rows, width), mem.rstd[layer - 1],
                vector(value, below[GAIN], width), vector(grad, below[GAIN], width),
                vector(grad, below[OFFSET], width),
            )  # fmt: skip
        _sum_rows(through, vector(grad, below[BIAS], width))
        down = through


@compiled  # type: ignore[untyped-decorator]
def exp(x: Any) -> Any:
    """``exp(x)`` of a float32, up to 3e-7 of it; vectorised, as libm's is not. x: at most +-80."""
    y = min(max(x, -_MOST), _MOST)
    scaled = y * _LOG2_E
    whole = _I(scaled + (_HALF if scaled >= _ZERO else -_HALF))
    f = y - _F(whole) * _LN_2
    power = _ONE + f * (_ONE + f * (_HALF + f * (_C3 + f * (_C4 + f * (_C5 + f * _C6)))))
    return power * as_float(_U((whole + _I(127)) << _I(23)))


@compiled  # type: ignore[untyped-decorator]
def sigmoid(x: Any) -> Any:
    """``1 / (1 + exp(-x))`` of a float32, up to 3e-7."""
    return _ONE / (_ONE + exp(-x))


@compiled  # type: ignore[untyped-decorator]
def adam_of_layers(
    value: Array, grad: Array, first: Array, second: Array, layout: Array, step: int,
    learning_rate: float,
) -> None:  # fmt: skip
    """As `adam`, of the parameters in ``layout`` alone."""
    for at in layout:
        for kind in range(WEIGHT, OFFSET + 1):
            start = at[kind]
            length = at[COLUMNS] * (at[ROWS] if kind == WEIGHT else 1)
            if start >= 0:
                adam(
                    vector(value, start, length), vector(grad, start, length),
                    vector(first, start, length), vector(second, start, length),
                    step, learning_rate,
                )  # fmt: skip


@compiled  # type: ignore[untyped-decorator]
def adam(
    value: Array, grad: Array, first: Array, second: Array, step: int, learning_rate: float
) -> None:
    """Step number ``step``, from 1, down the gradient: see `Adam`; all are ``[P]``."""
    size = _F(learning_rate / (1.0 - BETA_1**step))
    scale = _F(1.0 / np.sqrt(1.0 - BETA_2**step))
    for i in range(len(value)):
        first[i] += _B1 * (grad[i] - first[i])
    for i in range(len(value)):
        second[i] = _B2 * second[i] + (_ONE - _B2) * grad[i] * grad[i]
    for i in range(len(value)):
        value[i] -= size * first[i] / (np.sqrt(second[i]) * scale + _EPS)


@compiled  # type: ignore[untyped-decorator]
def shorten(grad: Array, most: float) -> None:
    """Shorten a gradient, ``[P]``, to a norm; 0: leave it."""
    if most <= 0:
        return
    squares = _ZERO
    for i in range(len(grad)):
        squares += grad[i] * grad[i]
    factor = _F(min(most / (np.sqrt(squares) + 1e-6), 1.0))
    for i in range(len(grad)):
        grad[i] *= factor


@compiled  # type: ignore[untyped-decorator]
def gather(table: Array, rows: Array, room: Array) -> Any:
    """Copy rows, by their numbers ``[M]``, of ``[N, W]`` to the first M of ``room``; a view."""
    into = room[: len(rows)]
    for n in range(len(rows)):
        row, found = into[n], table[rows[n]]
        for j in range(len(row)):
            row[j] = found[j]
    return into


@compiled  # type: ignore[untyped-decorator]
def vector(flat: Array, start: int, length: int) -> Any:
    """So many numbers of a vector, a view."""
    return flat[start : start + length]


@compiled  # type: ignore[untyped-decorator]
def matrix(flat: Array, start: int, rows: int, columns: int) -> Any:
    """The same as a matrix."""
    return flat[start : start + rows * columns].reshape(rows, columns)


@compiled  # type: ignore[untyped-decorator]
def add(row: Array, other: Array) -> None:
    """Add to every number of a row another."""
    for j in range(len(row)):
        row[j] += other[j]


@compiled  # type: ignore[untyped-decorator]
def _sum_rows(x: Array, into: Array) -> None:
    into[:] = _ZERO
    for n in range(len(x)):
        add(into, x[n])


@compiled  # type: ignore[untyped-decorator]
def _multiply(row: Array, other: Array) -> None:
    for j in range(len(row)):
        row[j] *= other[j]


@compiled  # type: ignore[untyped-decorator]
def _activate_row(row: Array, silu: int, out: Array, slope: Array) -> None:
    """Up to 6e-7."""
    if silu:
        for j in range(len(row)):
            part = sigmoid(row[j])
            out[j] = row[j] * part
            slope[j] = part * (_ONE + row[j] * (_ONE - part))
    else:
        for j in range(len(row)):
            bent = _TWO * sigmoid(_TWO * row[j]) - _ONE
            out[j] = bent
            slope[j] = _ONE - bent * bent


@compiled  # type: ignore[untyped-decorator]
def _activate(x: Array, bias: Array, silu: int, out: Array, slope: Array) -> None:
    """Add the bias to ``x``, in place, and activate it: ``[M, W]``."""
    for n in range(len(x)):
        add(x[n], bias)
        _activate_row(x[n], silu, out[n], slope[n])


@compiled  # type: ignore[untyped-decorator]
def _normalise(
    x: Array, bias: Array, gain: Array, offset: Array, silu: int, out: Array, slope: Array,
    rstd: Array,
) -> None:  # fmt: skip
    """Add the bias to ``x``, normalise it in place, and activate what gain and offset make of it.

    ``[M, W]``; fills ``rstd [M]`` with one over the deviation.
    """
    part = _ONE / _F(x.shape[1])
    affine = np.empty(x.shape[1], _F)
    for n in range(len(x)):
        row = x[n]
        add(row, bias)
        mean = _ZERO
        for j in range(len(row)):
            mean += row[j]
        mean *= part
        squares = _ZERO
        for j in range(len(row)):
            centred = row[j] - mean
            squares += centred * centred
        rstd[n] = scale = _ONE / np.sqrt(squares * part + _LAYER_NORM_EPS)
        for j in range(len(row)):
            row[j] = (row[j] - mean) * scale
        for j in range(len(row)):
            affine[j] = row[j] * gain[j] + offset[j]
        _activate_row(affine, silu, out[n], slope[n])


@compiled  # type: ignore[untyped-decorator]
def _through_norm(
    grad: Array, normal: Array, rstd: Array, gain: Array, by_gain: Array, by_offset: Array
) -> None:
    """Turn the gradient by gain and offset's outcome into that by the input, in place: ``[M, W]``.

    Overwrites the gradients by gain and offset.
    """
    width = grad.shape[1]
    part, scaled = _ONE / _F(width), np.empty(width, _F)
    by_gain[:] = _ZERO
    by_offset[:] = _ZERO
    for n in range(len(grad)):
        down, row, scale = grad[n], normal[n], rstd[n]
        add(by_offset, down)
        for j in range(width):
            by_gain[j] += down[j] * row[j]
        across, along = _ZERO, _ZERO
        for j in range(width):
            scaled[j] = down[j] * gain[j]
        for j in range(width):
            across += scaled[j]
            along += scaled[j] * row[j]
        across *= part
        along *= part
        for j in range(width):
            down[j] = scale * (scaled[j] - across - row[j] * along)
