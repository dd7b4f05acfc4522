"""The body that policy, Q and V share, and its gradient, written out.

Autograd would do the same. But the bookkeeping of its graph costs more than the arithmetic of
networks as small as these, and an update makes hundreds of small steps: so a step is a plain
sequence of kernels here. ``tests/learner/networks/test_body.py`` compares it to autograd.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from a2s.learner.networks.layer_norm import LAYER_NORM_EPS
from a2s.learner.on_policy.config import Init
from a2s.learner.on_policy.presets import AnyOnPolicyConfig

_aten = torch.ops.aten


class Layer(NamedTuple):
    """What one layer saw and made: inputs and, for hidden layers, each stage up to its output.

    Without layer normalisation ``normal``, ``mean`` and ``rstd`` are the sums themselves.
    """

    seen: Tensor
    linear: Tensor
    normal: Tensor
    mean: Tensor
    rstd: Tensor
    out: Tensor


class Body(nn.Module):
    """Linear, layer normalisation (optional) and tanh for each hidden layer; then Linear.

    Args:
        sizes: Units of input, hidden layers and output.
        hyper: Gives layer_norm and init.
        output_gain: Gain of the output layer in the init ``orthogonal``.
        generator: Draws the first weights.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        hyper: AnyOnPolicyConfig,
        output_gain: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.layer_norm = hyper.layer_norm
        gains = [math.sqrt(2.0)] * (len(sizes) - 2) + [output_gain]
        weight, bias = [], []
        for index, (rows, columns, gain) in enumerate(
            zip(sizes[:-1], sizes[1:], gains, strict=True)
        ):
            limit = 1.0 if index < len(sizes) - 2 else 0.1
            drawn = torch.empty(rows, columns)
            _draw(drawn, hyper.init, limit, gain, generator)
            weight.append(nn.Parameter(drawn))
            bias.append(nn.Parameter(torch.zeros(columns)))
        self.weight = nn.ParameterList(weight)
        self.bias = nn.ParameterList(bias)
        hidden = sizes[1:-1] if hyper.layer_norm else ()
        self.gain = nn.ParameterList([nn.Parameter(torch.ones(n)) for n in hidden])
        self.offset = nn.ParameterList([nn.Parameter(torch.zeros(n)) for n in hidden])
        # The same parameters: looking one up in a ParameterList takes as long as a small kernel.
        self._sums = list(zip(weight, bias, strict=True))
        self._norms = list(zip(self.gain, self.offset, strict=True))

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs ``[N, in]`` to outputs ``[N, out]``."""
        return self.after_first(torch.addmm(self.bias[0], x, self.weight[0]))

    def after_first(self, x: Tensor) -> Tensor:
        """Go on from the sums of the first layer, ``[N, hidden]``, to ``[N, out]``."""
        for index, (weight, bias) in enumerate(self._sums[1:]):
            if self.layer_norm:
                x = F.layer_norm(x, x.shape[-1:], *self._norms[index], LAYER_NORM_EPS)
            x = torch.addmm(bias, torch.tanh(x), weight)
        return x

    @torch.no_grad()
    def trace(self, x: Tensor) -> tuple[Tensor, list[Layer]]:
        """Map inputs like `forward`, and keep what `differentiate` needs.

        Args:
            x: Inputs, ``[N, in]``.

        Returns:
            Outputs, ``[N, out]``, and the layers.
        """
        layers, seen = [], x
        for index, (weight, bias) in enumerate(self._sums[:-1]):
            linear = torch.addmm(bias, seen, weight)
            normal = mean = rstd = inner = linear
            if self.layer_norm:
                normal, mean, rstd = torch.native_layer_norm(
                    linear, linear.shape[-1:], None, None, LAYER_NORM_EPS
                )
                gain, offset = self._norms[index]
                inner = torch.addcmul(offset, normal, gain)
            out = torch.tanh(inner)
            layers.append(Layer(seen, linear, normal, mean, rstd, out))
            seen = out
        weight, bias = self._sums[-1]
        out = torch.addmm(bias, seen, weight)
        layers.append(Layer(seen, out, out, out, out, out))
        return out, layers

    @torch.no_grad()
    def differentiate(self, layers: list[Layer], grad: Tensor) -> None:
        """Overwrite the gradients of all parameters.

        Args:
            layers: Of `trace`.
            grad: Gradient of the loss with respect to the outputs, ``[N, out]``.
        """
        for index in reversed(range(len(layers))):
            weight, bias = self._sums[index]
            torch.mm(layers[index].seen.mT, grad, out=weight.grad)
            torch.sum(grad, 0, out=bias.grad)
            if index > 0:
                below = layers[index - 1]
                grad = _aten.tanh_backward(torch.mm(grad, weight.mT), below.out)
                if self.layer_norm:
                    grad = self._through_norm(index - 1, below, grad)

    def _through_norm(self, index: int, layer: Layer, grad: Tensor) -> Tensor:
        gain, offset = self._norms[index]
        torch.sum(grad * layer.normal, 0, out=gain.grad)
        torch.sum(grad, 0, out=offset.grad)
        through: Tensor = _aten.native_layer_norm_backward(
            grad * gain,
            layer.linear,
            grad.shape[-1:],
            layer.mean,
            layer.rstd,
            None,
            None,
            [True, False, False],
        )[0]
        return through


def _draw(
    weight: Tensor, init: Init, limit: float, gain: float, generator: torch.Generator
) -> None:
    """Fill a layer's weights ``[in, out]`` with their first values."""
    if init == "uniform":
        nn.init.uniform_(weight, -limit, limit, generator=generator)
    else:
        nn.init.orthogonal_(weight, gain=gain, generator=generator)
