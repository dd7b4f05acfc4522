"""The processes of one learner, as torchrun starts them; here alone is torch.distributed.

The first leads: it alone has actors, a replay and a run directory. What changes its algorithm it
tells the others, and all do it alike (docs/adr/0037).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, NamedTuple

import torch
import torch.distributed
from torch import Tensor
from torch.distributed.rendezvous import rendezvous

from a2s.learner.networks.peers import Peers
from a2s.learner.torchrun import number_and_count
from a2s.protocol.errors import A2SError

END = "end"
_HEADER_BYTES = 8192
_MEET_WITHIN = timedelta(minutes=5)
_FOR_EVER = timedelta(days=365)  # a learner may wait for its actors; who dies is noticed at once


class Call(NamedTuple):
    """What the first process tells the others: a name, and what goes with it."""

    name: str
    tensors: list[Tensor]
    about: dict[str, Any]


class Processes(Peers):
    """Several processes on the CPU, with an equal part of every ensemble each.

    Raises:
        A2SError: From all methods: another process is gone.
    """

    def __init__(self) -> None:
        self.number = torch.distributed.get_rank()
        self.count = torch.distributed.get_world_size()

    def own(self, members: int) -> slice:
        """Members in the order of processes."""
        each = members // self.count
        return slice(self.number * each, (self.number + 1) * each)

    def gather(self, own: Tensor) -> Tensor:
        """By gloo, in the order of processes."""
        found = own.new_empty(self.count * len(own), *own.shape[1:])
        with _told():
            torch.distributed.all_gather_into_tensor(found, own.contiguous())
        return found

    def pick(self, own: Tensor, owner: Tensor) -> Tensor:
        """All rows go to all processes."""
        found = self.gather(own.unsqueeze(0))
        return found[owner, torch.arange(len(own))]

    def tell(self, name: str, *tensors: Tensor, **about: Any) -> None:
        """Tell all others what to do; for the first process."""
        kinds = [(str(each.dtype).removeprefix("torch."), list(each.shape)) for each in tensors]
        text = json.dumps([name, kinds, about]).encode()
        header = torch.zeros(_HEADER_BYTES, dtype=torch.uint8)
        header[: len(text)] = torch.frombuffer(bytearray(text), dtype=torch.uint8)
        with _told():
            for each in (header, *tensors):
                torch.distributed.broadcast(each.contiguous(), 0)

    def hear(self) -> Call:
        """Wait for what the first process tells."""
        header = torch.empty(_HEADER_BYTES, dtype=torch.uint8)
        with _told():
            torch.distributed.broadcast(header, 0)
            name, kinds, about = json.loads(header.numpy().tobytes().rstrip(b"\0"))
            tensors = [torch.empty(shape, dtype=getattr(torch, kind)) for kind, shape in kinds]
            for each in tensors:
                torch.distributed.broadcast(each, 0)
        return Call(name, tensors, about)


@contextmanager
def joined() -> Iterator[Processes | None]:
    """Meet the other processes; ``None``: there are none. At the end the first ends the others.

    Raises:
        A2SError: They cannot be reached.
    """
    number, count = number_and_count()
    if count == 1:
        yield None
        return
    with _told():
        store, *_ = next(rendezvous("env://", timeout=_MEET_WITHIN))
        torch.distributed.init_process_group(
            "gloo", store=store, rank=number, world_size=count, timeout=_FOR_EVER
        )
    try:
        processes = Processes()
        try:
            yield processes
        finally:
            if processes.number == 0:
                with suppress(A2SError):  # they are gone
                    processes.tell(END)
    finally:
        torch.distributed.destroy_process_group()


@contextmanager
def _told() -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as error:  # gloo's, and those of its rendezvous
        said = str(error).splitlines()[0]
        raise A2SError(
            f"another process of torchrun is gone, or cannot be reached: {said}; look at what it "
            "said, and start all of them again with --resume"
        ) from None
