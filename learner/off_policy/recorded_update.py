"""An off-policy update whose tensors keep their places, so that a GPU can record and repeat it.

An update is some 300 kernels of microseconds. On a GPU, starting them one by one takes longer than
running them; a recorded update is started as one (a CUDA graph).
"""

from collections.abc import Callable

import torch
from torch import Tensor

from a2s.learner.off_policy.transitions import Transitions
from a2s.learner.off_policy.update import OffPolicy, OffPolicyStats

Update = Callable[[], OffPolicyStats]
_WARM_UPS = 3


class RecordedUpdate:
    """`OffPolicy.update`, recorded at its first call and repeated at every other.

    The numbers are those of `OffPolicy.update`. Those returned are overwritten by the next call.
    ``record`` is given the update, may run it any number of times, and returns a function that
    repeats it: the same kernels on the same memory.
    """

    def __init__(self, algorithm: OffPolicy, record: Callable[[Update], Update]) -> None:
        self._algorithm = algorithm
        self._record = record
        self._places: list[Tensor] = []
        self._repeat: Update | None = None

    def __call__(self, batch: Transitions) -> OffPolicyStats:
        """Learn from a batch; its size is always the same."""
        noise = self._algorithm.draw_noise(len(batch.obs))
        if self._repeat is None:
            device = self._algorithm.device
            batch = Transitions(*(each.to(device, copy=True) for each in batch))
            self._places = [*batch, *noise]
            before = self._algorithm.state()
            self._repeat = self._record(lambda: self._algorithm.update(batch, noise))
            self._algorithm.load(before)
        else:
            for place, new in zip(self._places, [*batch, *noise], strict=True):
                place.copy_(new, non_blocking=True)
        return self._repeat()


def update_of(algorithm: OffPolicy) -> Callable[[Transitions], OffPolicyStats]:
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
