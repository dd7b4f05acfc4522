"""The parameters of a network as views of one vector, and the gradients by them."""

import dataclasses
import functools
from typing import NamedTuple

from torch import Tensor

from a2s.protocol.fields import Array

# Columns of `Form.layout`.
ROWS, COLUMNS, WEIGHT, BIAS, GAIN, OFFSET, SILU = range(7)


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


class Weights(NamedTuple):
    """The parameters of a network, or their gradients.

    Attributes:
        weight: Of each Linear, ``[E, in, out]``, in the precision of matrix products; of a single
            network ``[in, out]``.
        bias: ``[E, 1, out]``, or ``[out]``.
        norms: Of each Norm, float32.
    """

    weight: list[Tensor]
    bias: list[Tensor]
    norms: list[Affine]

    def all(self) -> list[Tensor]:
        """Every tensor once, in an order of its own."""
        gains, offsets = ([getattr(x, name) for x in self.norms] for name in ("gain", "offset"))
        return [*self.weight, *self.bias, *gains, *offsets]

    def pick(self, members: Tensor) -> "Weights":
        """Those of some members by their numbers, int64 ``[N]``: gathered, not views."""
        return Weights(
            [each.index_select(0, members) for each in self.weight],
            [each.index_select(0, members) for each in self.bias],
            [each.pick(members) for each in self.norms],
        )
