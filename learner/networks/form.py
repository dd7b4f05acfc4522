"""The layers of a network, and where their parameters are in one vector."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from a2s.learner.networks.layer_norm import Norm
from a2s.learner.networks.layers import Activation, Layer, Linear, Residual
from a2s.learner.networks.options import Activation as Function
from a2s.learner.networks.options import Init, Network
from a2s.learner.networks.weights import (
    BIAS,
    COLUMNS,
    GAIN,
    OFFSET,
    ROWS,
    WEIGHT,
    Affine,
    Weights,
)
from a2s.protocol.fields import Array


class Form:
    """Layers of a network, and where their parameters are in a vector.

    A vector holds all weights, all biases, all gains and all offsets, each of them for all members
    side by side, so that a product of all members reads one piece of memory: it would be copied for
    every product otherwise.

    ``mlp``: Linear, layer normalisation, activation for each hidden layer; then Linear.
    ``residual``: Linear to the first hidden size; for each further one a block that adds to its
    input normalisation, Linear to that size, activation and Linear back; then normalisation and
    Linear. ``trunk``: as ``mlp``, but the ``late`` inputs, an action, come in behind the first
    hidden layer: it is computed once however many actions there are.

    Args:
        sizes: Units of input, hidden layers or blocks, and output.
        network: One of the three.
        activation: Of all hidden layers.
        layer_norm: Whether there is any normalisation.
        late: The last inputs that a ``trunk`` does not see; 0 makes it an ``mlp``.

    Source: for ``residual`` SimBa (Lee et al. 2024), figure 4; for ``trunk`` the multi-action Q
    that the paper names as future work.
    """

    def __init__(
        self,
        sizes: tuple[int, ...],
        *,
        network: Network = "mlp",
        activation: Function,
        layer_norm: bool,
        late: int = 0,
    ) -> None:
        self.sizes = sizes
        self.network = network
        self.activation = activation
        self.layer_norm = layer_norm
        self.late = late if network == "trunk" else 0
        self.linears: list[tuple[int, int]] = []
        self.norms: list[Norm] = []
        self._norm_widths: list[int] = []
        inputs, *hidden, outputs = sizes
        self.trunk: list[Layer] = []
        if self.late:
            width = hidden.pop(0)
            self.trunk, width = self._chain(inputs - late, [width])
            self.enter = _linear(self.trunk)
            inputs = width + late
        if network == "residual":
            self.layers, width = self._blocks(inputs, *hidden)
        else:
            self.layers, width = self._chain(inputs, hidden)
        self.layers.append(self._linear(width, outputs))
        self.first = _linear(self.layers)
        length = sum((rows + 1) * columns for rows, columns in self.linears)
        length += 2 * sum(self._norm_widths)
        # A kernel rounds the rest of a vector of no whole number of registers in another way.
        self.length = -(-length // 16) * 16

    def weights(self, flat: Tensor, *, single: bool = False) -> Weights:
        """Views of a vector ``[E length]``; if single, E is 1 and no view has that dimension."""
        members = len(flat) // self.length
        matrix = () if single else (members,)
        vector = () if single else (members, 1)
        weight_shapes = [(*matrix, *shape) for shape in self.linears]
        widths = [out for _, out in self.linears] + 2 * self._norm_widths
        parts = _views(flat, weight_shapes + [(*vector, width) for width in widths])
        weight, bias = ([next(parts) for _ in self.linears] for _ in range(2))
        gains, offsets = ([next(parts) for _ in self.norms] for _ in range(2))
        norms = [
            Affine(gain, offset, None if norm.bias is None else bias[norm.bias])
            for gain, offset, norm in zip(gains, offsets, self.norms, strict=True)
        ]
        return Weights(weight, bias, norms)

    def layout(self, members: int, member: int, start: int = 0) -> Array:
        """Where the parameters of a member are in a vector ``[E length]`` that begins at ``start``.

        Int64 ``[layers, 7]``: inputs, outputs, first place of weight, bias, gain and offset, -1
        where a layer has no normalisation, and 1 for silu, 0 for tanh. Only for `Linear`s in a
        chain.
        """
        silu = int(self.activation == "silu")
        layers = [[rows, columns, 0, 0, -1, -1, silu] for rows, columns in self.linears]
        for column in (WEIGHT, BIAS, GAIN, OFFSET):
            for at in layers[: len(self.norms) if column in (GAIN, OFFSET) else None]:
                size = at[ROWS] * at[COLUMNS] if column == WEIGHT else at[COLUMNS]
                at[column] = start + member * size
                start += members * size
        return np.array(layers)

    def draw(
        self,
        members: int,
        generator: torch.Generator,
        *,
        init: Init = "fan-in",
        output_gain: float = 1.0,
    ) -> Tensor:
        """First parameters, ``[E length]``; gains are 1 and offsets 0.

        Args:
            members: E.
            generator: Draws them.
            init: ``fan-in``: weights and biases uniform in +-1/sqrt(inputs). In the others biases
                are 0: ``uniform``: weights in +-1, of the last layer in +-0.1; ``orthogonal``: with
                a gain of sqrt(2), for one member alone.
            output_gain: Gain of the last layer in ``orthogonal``.
        """
        flat = torch.zeros(members * self.length)
        weights = self.weights(flat, single=init == "orthogonal")
        last = len(self.linears) - 1
        for index, (weight, bias) in enumerate(zip(weights.weight, weights.bias, strict=True)):
            if init == "orthogonal":
                gain = output_gain if index == last else math.sqrt(2.0)
                nn.init.orthogonal_(weight, gain=gain, generator=generator)
            elif init == "uniform":
                limit = 0.1 if index == last else 1.0
                weight.uniform_(-limit, limit, generator=generator)
            else:
                limit = 1.0 / math.sqrt(weight.shape[1])
                for each in (weight, bias):
                    each.uniform_(-limit, limit, generator=generator)
        for affine in weights.norms:
            affine.gain.fill_(1.0)
        return flat

    def _linear(self, rows: int, columns: int, *, adds_bias: bool = True) -> Linear:
        self.linears.append((rows, columns))
        return Linear(len(self.linears) - 1, adds_bias=adds_bias)

    def _norm(self, width: int, *, relu: bool = False, bias: int | None = None) -> list[Layer]:
        if not self.layer_norm:
            return []
        compiled = self.activation == "relu"
        norm = Norm(len(self.norms), bias=bias, relu=relu, compiled=compiled)
        self.norms.append(norm)
        self._norm_widths.append(width)
        return [norm]

    def _chain(self, rows: int, widths: list[int]) -> tuple[list[Layer], int]:
        """Linear, normalisation and activation for each width; also returns the last width."""
        fused = self.layer_norm and self.activation == "relu"
        layers: list[Layer] = []
        for width in widths:
            linear = self._linear(rows, width, adds_bias=not fused)
            layers += [linear, *self._norm(width, relu=fused, bias=linear.index if fused else None)]
            layers += [] if fused else [Activation(self.activation)]
            rows = width
        return layers, rows

    def _blocks(self, rows: int, width: int, *inner: int) -> tuple[list[Layer], int]:
        """Linear, residual blocks, and a last normalisation; also returns the width."""
        layers: list[Layer] = [self._linear(rows, width)]
        for size in inner:
            block = [*self._norm(width), self._linear(width, size), Activation(self.activation)]
            layers.append(Residual([*block, self._linear(size, width)]))
        return layers + self._norm(width), width


def _linear(layers: list[Layer]) -> Linear:
    """The first layer."""
    first = layers[0]
    assert isinstance(first, Linear)
    return first


def _views(flat: Tensor, shapes: list[tuple[int, ...]]) -> Iterator[Tensor]:
    start = 0
    for shape in shapes:
        end = start + math.prod(shape)
        yield flat[start:end].view(shape)
        start = end
