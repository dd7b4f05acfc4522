"""Huber loss of quantile regression over all pairs of atoms, compiled (docs/adr/0007).

Nothing of the size of the pairs is stored: 1,150 of them a row and critic, at 25 atoms and 46 of
the target.
"""

import numba
import numpy as np

from a2s.protocol.fields import Array

_F = np.float32
_ZERO, _HALF, _ONE = _F(0.0), _F(0.5), _F(1.0)


@numba.njit(  # type: ignore[untyped-decorator]
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}
)
def fill(q_value: Array, target: Array, loss: Array, grad: Array, width: np.float32) -> None:
    """Fill, with means over the atoms of the target, ``loss`` and ``grad``, ``[E, B, M]`` both.

    They are the loss of each atom and its gradient by the atom. ``q_value`` is ``[E, B, M]``,
    ``target`` ``[B, M']``, ``width`` kappa.
    """
    members, rows, atoms = q_value.shape
    share = _ONE / _F(target.shape[1])
    narrow, half_width = _ONE / width, _HALF * width
    for e in range(members):
        for b in range(rows):
            wanted = target[b]
            for m in range(atoms):
                above = (_F(m) + _HALF) / _F(atoms)
                below = _ONE - above
                value, force, cost = q_value[e, b, m], _ZERO, _ZERO
                for k in range(len(wanted)):
                    delta = wanted[k] - value
                    limited = min(max(delta * narrow, -_ONE), _ONE)
                    blamed = limited * (below if delta < _ZERO else above)
                    force += blamed
                    cost += blamed * (delta - half_width * limited)
                loss[e, b, m] = cost * share
                grad[e, b, m] = -force * share
