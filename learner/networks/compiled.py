"""Running compiled loops over networks: their memory as arrays, one thread for each."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import threadpoolctl

from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.protocol.fields import Array


class Vectors(NamedTuple):
    """Parameters, gradients and moments of Adam, float32 ``[P]`` each, and where each layer's are.

    The layout is that of `Form.layout`.
    """

    value: Array
    grad: Array
    first: Array
    second: Array
    layout: Array


def vectors(optimiser: Adam, network: Ensemble, grad: Any, *, member: int = 0) -> Vectors:
    """The memory of a member of a network, not copied; what the optimiser has beside it is before.

    ``grad`` is the gradient of all that the optimiser has.
    """
    held = optimiser.arrays()
    start = len(held[0]) - len(network.value)
    layout = network.form.layout(network.members, member, start)
    return Vectors(held[0], grad.numpy(), *held[1:], layout)


def run_together(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Call all of them, each in a thread; BLAS has one thread for each. Results are in order."""
    with _blas().limit(limits=1, user_api="blas"):
        if len(calls) == 1:
            return [calls[0]()]
        with ThreadPoolExecutor(len(calls)) as pool:
            return [each.result() for each in [pool.submit(call) for call in calls]]


@functools.cache
def _blas() -> threadpoolctl.ThreadpoolController:
    import scipy.linalg.cython_blas  # noqa: F401 - what the compiled loops call, to be loaded

    return threadpoolctl.ThreadpoolController()
