"""A learner that lets only known peers in, as tests see it."""

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from a2s.protocol.codec import decode
from a2s.protocol.keys import Keys
from a2s.protocol.messages import RunStatus
from a2s.protocol.zenoh_bus import ZenohBus


def free_port() -> int:
    """A port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True, slots=True)
class Site:
    """A learner, and the way in.

    Attributes:
        endpoint: Where it listens.
        keys: Of its run.
        bus: Its own connection.
        path: Directory of the run.
        peer: Connects as the peer of this name.
    """

    endpoint: str
    keys: Keys
    bus: ZenohBus
    path: Path
    peer: Callable[[str], ZenohBus]

    def wait_for_weights(self) -> None:
        """Wait until there are some; before, the answer is empty."""
        for _ in range(3000):
            if self.bus.ask(self.keys.weights, b"", 5.0):
                return
            threading.Event().wait(0.02)
        raise AssertionError("the learner never published weights")

    def status(self, bus: ZenohBus) -> RunStatus:
        """Ask for it until it is answered; what was sent before on this link was heard."""
        for _ in range(200):
            answer = bus.ask(self.keys.status, b"", 5.0)
            if answer is not None:
                told = decode(answer, RunStatus)
                assert isinstance(told, RunStatus)
                return told
            threading.Event().wait(0.02)
        raise AssertionError("the learner never answered")
