"""Running compiled loops over networks: their memory as arrays, one thread for each."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import threadpoolctl
from torch import Tensor

from a2s.learner.networks import step_kernels
from a2s.learner.networks.adam import Adam
from a2s.learner.networks.ensemble import Ensemble
from a2s.protocol.fields import Array

_ROWS_AT_ONCE = 512


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


def outputs(*pairs: tuple[Ensemble, Tensor]) -> list[Tensor]:
    """Outputs of single networks for inputs ``[N, in]``, ``[N, out]``, side by side."""
    into = [x.new_empty(len(x), network.form.sizes[-1]) for network, x in pairs]
    run_together(
        [
            partial(
                step_kernels.evaluate, network.value.numpy(), network.form.layout(1, 0),
                x.numpy(), _ROWS_AT_ONCE, out.numpy(),
            )
            for (network, x), out in zip(pairs, into, strict=True)
        ]
    )  # fmt: skip
    return into


def run_together(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Call all of them, each in a thread; BLAS has one thread for each. Results are in order."""
    first, *others = calls
    with _blas().limit(limits=1, user_api="blas"):
        begun = [_threads().submit(call) for call in others]
        try:
            result = first()
        finally:
            wait(begun)
    return [result, *(each.result() for each in begun)]


def is_kept(kernel: Any) -> bool:
    """Whether a compiled loop is kept on this machine, for any kind of arguments."""
    kept, name = Path(kernel.stats.cache_path or ""), kernel.__name__
    return any(kept.glob(f"{kernel.__module__.rsplit('.', 1)[-1]}.{name}-*.nbi"))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="fit")


@functools.cache
def _blas() -> threadpoolctl.ThreadpoolController:
    import scipy.linalg.cython_blas  # noqa: F401 - what the compiled loops call, to be loaded

    return threadpoolctl.ThreadpoolController()
