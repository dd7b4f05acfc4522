"""Networks of equal form, evaluated and differentiated together; one is an ensemble of one.

Their gradient is written out: see ``body.py`` for why.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from a2s.learner.networks.layers import Layer, Linear, Norm, Relu, Residual, Weights, run, run_back
from a2s.learner.off_policy.config import Network, Precision

# Parameters start at multiples of this, so that kernels find them aligned.
_ALIGNMENT = 16


class Form:
    """Layers of a network, and where their parameters are in a vector.

    A vector holds each parameter of all members side by side, so that a product of all members
    reads one piece of memory: it would be copied for every product otherwise.

    ``mlp``: Linear, layer normalisation, ReLU for each hidden layer; then Linear. ``residual``:
    Linear to the first hidden size; for each further one a block that adds to its input
    normalisation, Linear to that size, ReLU and Linear back; then normalisation and Linear.
    ``trunk``: as ``mlp``, but the ``late`` inputs, an action, come in behind the first hidden
    layer: it is computed once however many actions there are.

    Args:
        sizes: Units of input, hidden layers or blocks, and output.
        network: One of the three.
        layer_norm: Whether there is any normalisation.
        late: The last inputs that a ``trunk`` does not see; 0 makes it an ``mlp``.

    Source: for ``residual`` SimBa (Lee et al. 2024), figure 4; for ``trunk`` the multi-action Q
    that the paper names as future work.
    """

    def __init__(
        self, sizes: tuple[int, ...], *, network: Network, layer_norm: bool, late: int = 0
    ) -> None:
        self.sizes = sizes
        self.network = network
        self.layer_norm = layer_norm
        self.late = late if network == "trunk" else 0
        self.shapes: list[tuple[int, int]] = []
        self.starts: list[int] = []
        self.length = 0
        self.norms: list[Norm] = []
        inputs, *hidden, outputs = sizes
        self.trunk: list[Layer] = []
        if self.late:
            width = hidden.pop(0)
            self.enter, self.trunk = self._chain(inputs - late, [width])
            inputs = width + late
        if network != "residual":
            self.first, self.layers = self._chain(inputs, hidden)
            width = hidden[-1]
        else:
            width = hidden[0]
            self.first = self._linear(inputs, width)
            self.layers = [self.first]
            for inner in hidden[1:]:
                block = [*self._norm(width), self._linear(width, inner), Relu()]
                self.layers.append(Residual([*block, self._linear(inner, width)]))
            self.layers += self._norm(width)
        self.layers.append(self._linear(width, outputs))

    def views(self, flat: Tensor) -> list[Tensor]:
        """The parameters in a vector ``[E length]``, each ``[E, rows, columns]``."""
        members = len(flat) // self.length
        return [
            flat[members * start :][: members * rows * columns].view(members, rows, columns)
            for start, (rows, columns) in zip(self.starts, self.shapes, strict=True)
        ]

    @property
    def gains(self) -> set[int]:
        """Numbers of the gains."""
        return {norm.gain for norm in self.norms}

    def weights(self, full: list[Tensor], product: list[Tensor]) -> Weights:
        """The same parameters in both precisions, and those of each normalisation."""
        return Weights(full, product, {norm.gain: norm.gather(full) for norm in self.norms})

    def draw(self, members: int, generator: torch.Generator) -> Tensor:
        """First parameters, ``[E length]``: of Linear uniform in +-1/sqrt(inputs)."""
        flat = torch.zeros(members * self.length)
        views = self.views(flat)
        gains = self.gains
        for index in range(0, len(views), 2):  # weight and bias, or gain and offset
            if index in gains:
                views[index].fill_(1.0)
                continue
            limit = 1.0 / math.sqrt(self.shapes[index][0])
            for view in views[index : index + 2]:
                view.uniform_(-limit, limit, generator=generator)
        return flat

    def _add(self, rows: int, columns: int) -> int:
        self.shapes.append((rows, columns))
        self.starts.append(self.length)
        self.length += -(-rows * columns // _ALIGNMENT) * _ALIGNMENT
        return len(self.shapes) - 1

    def _linear(self, rows: int, columns: int, *, adds_bias: bool = True) -> Linear:
        return Linear(self._add(rows, columns), self._add(1, columns), adds_bias=adds_bias)

    def _norm(self, width: int, *, relu: bool = False, bias: int | None = None) -> list[Layer]:
        if not self.layer_norm:
            return [Relu()] if relu else []
        self.norms.append(Norm(self._add(1, width), self._add(1, width), relu=relu, bias=bias))
        return [self.norms[-1]]

    def _chain(self, rows: int, widths: list[int]) -> tuple[Linear, list[Layer]]:
        """Linear, normalisation and ReLU for each width, and the first of them by itself."""
        linears: list[Linear] = []
        layers: list[Layer] = []
        for width in widths:
            linears.append(self._linear(rows, width, adds_bias=not self.layer_norm))
            layers += [linears[-1], *self._norm(width, relu=True, bias=linears[-1].bias)]
            rows = width
        return linears[0], layers


class Tape(NamedTuple):
    """What the layers of the trunk, and those above it, remember of one pass."""

    below: list[Any]
    above: list[Any]


class Ensemble:
    """E networks of one form with their parameters and gradients as one vector each.

    Args:
        form: Of each.
        flat: First parameters, float32 ``[E length]``; kept, not copied.
        precision: Of matrix products.

    Attributes:
        value: Parameters, float32 ``[E length]``; after a change call `refresh`.
        grad: Gradients of the same shape, written by `differentiate`.
        weights: Views of the parameters.
    """

    def __init__(self, form: Form, flat: Tensor, *, precision: Precision) -> None:
        self.form = form
        self.members = len(flat) // form.length
        self.value = flat
        self.grad = torch.zeros_like(flat)
        self._product = flat if precision == "f32" else flat.to(torch.bfloat16)
        self.weights = self._weights(self.value, self._product)
        self._grads = self._weights(self.grad, self.grad)

    def copy(self) -> "Ensemble":
        """The same networks with parameters of their own."""
        precision: Precision = "f32" if self._product is self.value else "bf16"
        return Ensemble(self.form, self.value.clone(), precision=precision)

    def refresh(self) -> None:
        """Take changed parameters into account."""
        if self._product is not self.value:
            self._product.copy_(self.value)

    def pick(self, index: Tensor) -> Weights:
        """The weights of some members, by their numbers, int64 ``[N]``; gathered, not views."""
        full = [each.index_select(0, index) for each in self.weights.full]
        if self._product is self.value:
            return self.form.weights(full, full)
        product = [each.index_select(0, index) for each in self.weights.product]
        return self.form.weights(full, product)

    def trace(self, x: Tensor) -> tuple[Tensor, Tape]:
        """Map inputs ``[N, in]`` or ``[E, N, in]`` to ``[E, N, out]``.

        Returns:
            The outputs, and what `differentiate` needs.
        """
        form = self.form
        below: list[Any] = []
        x = x.expand(self.members, *x.shape[-2:])
        if form.trunk:
            shown, late = x[..., : -form.late], x[..., -form.late :]
            inner, below = run(form.trunk, self.weights, shown)
            x = torch.cat([inner, late.to(inner.dtype)], dim=-1)
        out, above = run(form.layers, self.weights, x)
        return out.to(self.value.dtype), Tape(below, above)

    def __call__(self, x: Tensor) -> Tensor:
        """The outputs of `trace`."""
        return self.trace(x)[0]

    def differentiate(self, tape: Tape, grad: Tensor) -> None:
        """Overwrite the gradients of all parameters.

        Args:
            tape: From `trace`.
            grad: Gradient by the outputs, ``[E, N, out]``.
        """
        form, weights, grads, kind = self.form, self.weights, self._grads, self._product.dtype
        grad = run_back(form.layers[1:], weights, grads, tape.above[1:], grad)
        if not form.trunk:
            form.first.collect(grads, tape.above[0], grad.to(kind))
            return
        joined = form.first.backward(weights, grads, tape.above[0], grad)
        inner = joined[..., : -form.late]
        grad = run_back(form.trunk[1:], weights, grads, tape.below[1:], inner)
        form.enter.collect(grads, tape.below[0], grad.to(kind))

    def by_input(self, tape: Tape, grad: Tensor, start: int) -> Tensor:
        """Gradient by the inputs from ``start`` on, ``[E, N, in - start]``; no others are made.

        Of a ``trunk`` they must be among the late ones.
        """
        form = self.form
        grad = run_back(form.layers[1:], self.weights, None, tape.above[1:], grad)
        count = form.sizes[0] - start
        if form.trunk and count > form.late:
            raise ValueError(f"found {count} inputs, a trunk gives the gradient of {form.late}")
        weight = self.weights.product[form.first.weight]
        weight = weight[:, weight.shape[1] - count :]
        return torch.bmm(grad.to(weight.dtype), weight.mT).to(self.value.dtype)

    def _weights(self, full: Tensor, product: Tensor) -> Weights:
        views = self.form.views(full)
        low = views if product is full else self.form.views(product)
        return self.form.weights(views, low)


def score_many(form: Form, weights: Weights, obs: Tensor, action: Tensor) -> Tensor:
    """Evaluate several actions for every observation; its part is computed once.

    Args:
        form: Of the networks; their input is observation and action joined.
        weights: Of E members.
        obs: ``[B, D]``.
        action: Each member's own, ``[E, B, K, A]``.

    Returns:
        ``[E, B, K, out]``.
    """
    members, rows, count, size = action.shape
    weight = weights.product[form.first.weight]
    kind = weight.dtype
    shown = obs.to(kind).expand(members, rows, -1)
    if form.trunk:
        shown = run(form.trunk, weights, shown)[0].to(kind)
    split = shown.shape[2]
    seen = form.first.multiply(weights, shown, weight[:, :split])
    acted = torch.bmm(action.to(kind).view(members, -1, size), weight[:, split:])
    both = acted.view(members, rows, count, -1)
    both += seen.unsqueeze(2)
    out, _ = run(form.layers[1:], weights, both.view(members, rows * count, -1))
    return out.view(members, rows, count, -1).to(obs.dtype)
