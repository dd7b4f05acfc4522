"""Passes of gradient steps on the policy, V and Q, compiled (docs/adr/0022).

``net`` is a `Vectors`; ``order`` are numbers of rows, int64, of which the minibatch i is
``order[bounds[i]:bounds[i + 1]]``; ``step`` the optimiser's steps before. What is learned from is
float32. Losses that are returned are sums over the minibatches.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from a2s.learner.networks.kernels import compiled
from a2s.learner.networks.step_kernels import (
    above_first,
    adam,
    adam_of_layers,
    add,
    backward,
    exp,
    forward,
    gather,
    matrix,
    memory,
    shorten,
)
from a2s.learner.networks.weights import COLUMNS, WEIGHT
from a2s.protocol.fields import Array

_F = np.float32
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_HALF_LOG_2PI = np.float32(0.5 * np.log(2.0 * np.pi))
_MAX_LOG_RATIO = 20.0


class Surrogate(NamedTuple):
    """How the policy's loss is made, see `policy.improve`."""

    clip_ratio: float
    entropy_weight: float
    pull: float
    least_log_std: float


@compiled  # type: ignore[untyped-decorator]
def value_pass(
    net: Any, inputs: Array, target: Array, order: Array, bounds: Array, step: int,
    learning_rate: float, max_grad_norm: float,
) -> Any:  # fmt: skip
    """Steps down the squared error of a network of tanh with one output: ``[N, in]``, ``[N]``."""
    value, grad, first, second, layout = net
    room, total = _largest(bounds), 0.0
    mem, some = memory(layout, room), np.empty((room, inputs.shape[1]), _F)
    for i in range(len(bounds) - 1):
        rows = order[bounds[i] : bounds[i + 1]]
        x = gather(inputs, rows, some)
        out = forward(value, layout, x, mem)
        for n in range(len(rows)):
            error = out[n, 0] - target[rows[n]]
            total += error * error / len(rows)
            out[n, 0] = _F(2.0) * error / _F(len(rows))
        backward(value, grad, layout, x, mem, out)
        shorten(grad, max_grad_norm)
        adam(value, grad, first, second, step + i + 1, learning_rate)
    return total


@compiled  # type: ignore[untyped-decorator]
def q_pass(
    net: Any, inputs: Array, chance: Array, order: Array, bounds: Array, step: int,
    learning_rate: float,
) -> Any:  # fmt: skip
    """Steps down the cross-entropy of a network of silu to the chances of every row of ``order``.

    Inputs are ``[N, in]``, chances ``[len(order), BINS]``.
    """
    value, grad, first, second, layout = net
    room, total = _largest(bounds), 0.0
    mem, some = memory(layout, room), np.empty((room, inputs.shape[1]), _F)
    for i in range(len(bounds) - 1):
        rows = order[bounds[i] : bounds[i + 1]]
        x = gather(inputs, rows, some)
        out = forward(value, layout, x, mem)
        total += cross_entropy(out, chance[bounds[i] : bounds[i + 1]])
        backward(value, grad, layout, x, mem, out)
        adam_of_layers(value, grad, first, second, layout, step + i + 1, learning_rate)
    return total


@compiled  # type: ignore[untyped-decorator]
def policy_pass(
    net: Any, data: Any, wanted: Array, how: Any, order: Array, bounds: Array, step: int,
    learning_rate: float, max_grad_norm: float,
) -> Any:  # fmt: skip
    """Steps of the policy, whose parameters begin with the log deviation.

    ``data`` are the arrays obs, action, log_prob, advantage and weight of `policy.PolicyData`;
    ``wanted`` has no row where nothing pulls.

    Returns:
        PPO's loss, and that of equation 6: the divergence, in nats, of Gaussians that are as wide
        as the policy around its mean and around the wanted one. Equation 6 is about the mean.
    """
    value, grad, first, second, layout = net
    obs, action, old_log_prob, advantage, weight = data
    room, size, total, pulled = _largest(bounds), action.shape[1], 0.0, 0.0
    mem, some = memory(layout, room), np.empty((room, obs.shape[1]), _F)
    log_std, by_log_std, z = value[:size], grad[:size], np.empty(size, _F)
    for i in range(len(bounds) - 1):
        rows = order[bounds[i] : bounds[i + 1]]
        x = gather(obs, rows, some)
        out = forward(value, layout, x, mem)
        by_log_std[:] = _F(-how.entropy_weight)
        inverse, part = np.exp(-log_std), _ONE / _F(len(rows))
        highest = -(log_std.sum() + size * _HALF_LOG_2PI)
        for n in range(len(rows)):
            k, mean = rows[n], out[n]
            log_prob = highest
            for j in range(size):
                z[j] = (action[k, j] - mean[j]) * inverse[j]
                log_prob -= _HALF * z[j] * z[j]
            worth = weight[k] * advantage[k]
            loss, slope = clipped_loss(log_prob, old_log_prob[k], worth, how.clip_ratio)
            total += loss * part
            by_log_prob = _F(slope) * part
            for j in range(size):
                by_log_std[j] += by_log_prob * (z[j] * z[j] - _ONE)
                by_mean = by_log_prob * z[j] * inverse[j]
                if len(wanted):
                    apart = (mean[j] - wanted[k, j]) * inverse[j]
                    pulled += part * _HALF * apart * apart
                    by_mean += _F(how.pull) * part * apart * inverse[j]
                mean[j] = by_mean
        backward(value, grad, layout, x, mem, out)
        shorten(grad, max_grad_norm)
        adam(value, grad, first, second, step + i + 1, learning_rate)
        for j in range(size):
            log_std[j] = max(log_std[j], _F(how.least_log_std))
    return total, pulled


@compiled  # type: ignore[untyped-decorator]
def clipped_loss(log_prob: float, old_log_prob: float, worth: float, clip_ratio: float) -> Any:
    """Loss of a step, the ratio of densities clipped, and its derivative by ``log_prob``.

    In the first step the ratio is 1 and the derivative that of ``-log_prob * worth``, which is
    A2C's loss: equation 4 of the paper. ``policy_epochs=1`` and ``policy_minibatch=0`` make no
    other step. ``worth`` is the advantage by its weight.

    Source: Schulman et al. 2017, equation 7.
    """
    ratio = np.exp(min(log_prob - old_log_prob, _MAX_LOG_RATIO))
    free = ratio * worth
    limited = min(max(ratio, 1.0 - clip_ratio), 1.0 + clip_ratio) * worth
    if free <= limited:
        return -free, -free
    return -limited, 0.0


@compiled  # type: ignore[untyped-decorator]
def cross_entropy(logits: Array, chance: Array) -> Any:
    """Mean over M rows to their chances, ``[M, BINS]`` both; logits become the gradient by them."""
    rows, size = logits.shape
    part, total = _ONE / _F(rows), 0.0
    for n in range(rows):
        row, likely = logits[n], chance[n]
        most = _most(row)
        along = _ZERO
        for j in range(size):
            row[j] -= most
        for j in range(size):
            along += likely[j] * row[j]
        total -= float(along)
    softened = exp_of(logits.reshape(rows * size)).reshape(rows, size)
    for n in range(rows):
        row, likely, soft = logits[n], chance[n], softened[n]
        whole = _ZERO
        for j in range(size):
            whole += soft[j]
        total += np.log(whole)
        scale = part / whole
        for j in range(size):
            row[j] = soft[j] * scale - likely[j] * part
    return total / rows


@compiled  # type: ignore[untyped-decorator]
def expected(
    value: Array, layout: Array, obs: Array, action: Array, centres: Array, room: int, into: Array
) -> None:
    """Add the means of the chances that Q gives to ``centres [BINS]`` to ``into [N K]``.

    Observations are ``[N, D]``, actions ``[N K, A]``; ``room`` states are evaluated at once.
    """
    (states, size), count, at = obs.shape, len(action) // len(obs), layout[0]
    mem, width = memory(layout, room * count), at[COLUMNS]
    by_obs = matrix(value, at[WEIGHT], size, width)
    by_action = matrix(value, at[WEIGHT] + size * width, action.shape[1], width)
    shared = np.empty((room, width), _F)
    for start in range(0, states, room):
        some = obs[start : start + room]
        rows = len(some) * count
        np.dot(some, by_obs, shared[: len(some)])
        first = matrix(mem.before[0], 0, rows, width)
        np.dot(action[start * count : start * count + rows], by_action, first)
        for n in range(rows):
            add(first[n], shared[n // count])
        logits = above_first(value, layout, rows, mem)
        for n in range(rows):
            row = logits[n]
            most = _most(row)
            for j in range(len(row)):
                row[j] -= most
        softened = exp_of(logits.reshape(logits.size)).reshape(logits.shape)
        for n in range(rows):
            soft = softened[n]
            whole, along = _ZERO, _ZERO
            for j in range(len(soft)):
                whole += soft[j]
                along += soft[j] * centres[j]
            into[start * count + n] += along / whole


@compiled  # type: ignore[untyped-decorator]
def share_that_counts(score: Array, inverse_temperature: float) -> Any:
    """See `suggestions.share_that_counts`."""
    rows, count = score.shape
    tilt, factor = np.empty(score.shape, _F), _F(inverse_temperature)
    for n in range(rows):
        row, most = score[n], _most(score[n])
        for j in range(count):
            tilt[n, j] = factor * (row[j] - most)
    weights, total = exp_of(tilt.reshape(tilt.size)), 0.0
    for n in range(rows):
        whole, squares = _ZERO, _ZERO
        for j in range(n * count, (n + 1) * count):
            whole += weights[j]
            squares += weights[j] * weights[j]
        total += float(whole * whole / squares)
    return total / rows / count


@compiled  # type: ignore[untyped-decorator]
def exp_of(x: Array) -> Any:
    """All of them in one loop: rows of 51 would leave a part that is not vectorised."""
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = exp(x[i])
    return out


@numba.njit(cache=True, nogil=True, fastmath=True)  # type: ignore[untyped-decorator]
def _most(row: Array) -> Any:
    most = row[0]
    for j in range(len(row)):
        most = row[j] if row[j] > most else most
    return most


@compiled  # type: ignore[untyped-decorator]
def add_decayed(sums: Array, decay: Array) -> None:
    """Add to each number of ``[N]``, from the end, ``decay`` times what the next one became."""
    for t in range(len(sums) - 2, -1, -1):
        sums[t] += decay[t] * sums[t + 1]


@compiled  # type: ignore[untyped-decorator]
def _largest(bounds: Array) -> int:
    most = 0
    for i in range(len(bounds) - 1):
        most = max(most, bounds[i + 1] - bounds[i])
    return most
