"""What a2s needs of a network: questions, publications and presence.

Two classes have this shape: :class:`a2s.protocol.zenoh_bus.ZenohBus` for real runs, and
:class:`a2s.protocol.in_process.InProcessBus` for peers within one process. One suite of tests,
``tests/contract``, holds both to the words below.
"""

from collections.abc import Callable
from typing import Protocol

Answer = Callable[[bytes], bytes]
OnMessage = Callable[[bytes], None]
OnPresence = Callable[[str, bool], None]


class Bus(Protocol):
    """One peer's connection.

    Handlers run on threads of the bus, one message at a time per declaration; they must be quick.
    """

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Ask the peer that answers ``key``.

        Returns:
            The answer, or ``None`` when there was none: nobody answers, the peer died, or
            ``timeout_s`` seconds went by. The question may still have been read.
        """
        ...

    def answer(self, key: str, handler: Answer) -> None:
        """Answer the questions to ``key`` from now on; a handler that raises gives no answer."""
        ...

    def publish(self, key: str, payload: bytes) -> None:
        """Tell everybody who listens to ``key``, without waiting and without a promise."""
        ...

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Hear what is published on ``key`` from now on; ``*`` stands for one part of a key."""
        ...

    def declare_presence(self, key: str) -> None:
        """Be seen under ``key`` until this connection ends, however it ends."""
        ...

    def withdraw_presence(self, key: str) -> None:
        """No longer be seen under ``key``."""
        ...

    def watch_presence(self, key: str, handler: OnPresence) -> None:
        """Hear who is present, ``handler(key, True)``, and who leaves, ``handler(key, False)``.

        Those who are already present are told first.
        """
        ...

    def close(self) -> None:
        """End the connection; nothing is heard afterwards. May be called twice."""
        ...
