"""An off-policy update whose tensors keep their places, so that a GPU can record and repeat it.

An update is some 300 kernels of microseconds. On a GPU, starting them one by one takes longer than
running them; a recorded update is started as one (a CUDA graph).
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import torch

from a2s.learner.off_policy.noise import Noise
from a2s.learner.off_policy.stats import OffPolicyStats
from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy

Update = Callable[[], OffPolicyStats]
_WARM_UPS = 3


class RecordedUpdate:
    """`OffPolicy.update`, recorded at its first call of each kind and repeated at every other.

    The numbers are those of `OffPolicy.update`. Those returned are overwritten by the next call.
    ``record`` is given the update, may run it any number of times, and returns a function that
    repeats it: the same kernels on the same memory.
    """

    def __init__(self, algorithm: OffPolicy, record: Callable[[Update], Update]) -> None:
        self._algorithm = algorithm
        self._record = record
        self._places: tuple[Transitions, Noise] | None = None
        self._repeats: dict[bool, Update] = {}

    def __call__(self, batch: Transitions, *, learns_policy: bool = True) -> OffPolicyStats:
        """Learn from a batch; its size is always the same."""
        given = batch, self._algorithm.draw_noise(len(batch.obs))
        if self._places is None:
            device = self._algorithm.device
            batch = Transitions(*(each.to(device, copy=True) for each in batch))
            self._places = batch, given[1]
        else:
            for places, news in zip(self._places, given, strict=True):
                for place, new in zip(places, news, strict=True):
                    place.copy_(new, non_blocking=True)
        if learns_policy not in self._repeats:
            update = partial(self._algorithm.update, *self._places, learns_policy=learns_policy)
            before = self._algorithm.state()
            self._repeats[learns_policy] = self._record(update)
            self._algorithm.load(before)
        return self._repeats[learns_policy]()


class Updating(Protocol):
    """A way to learn from a batch."""

    def __call__(self, batch: Transitions, *, learns_policy: bool) -> OffPolicyStats:
        """As `OffPolicy.update` does."""
        ...


def update_of(algorithm: OffPolicy) -> Updating:
    """Choose the way to update by device: recorded on a GPU, directly elsewhere."""
    if algorithm.device.type == "cuda":
        return RecordedUpdate(algorithm, record_cuda)
    return algorithm.update


def record_cuda(update: Update) -> Update:
    """Record a CUDA graph, after some runs on a stream of their own, as CUDA wants it."""
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM_UPS):
            update()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        stats = update()

    def repeat() -> OffPolicyStats:
        graph.replay()
        return stats

    return repeat
