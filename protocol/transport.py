"""What a2s needs of a network: questions, publications and presence.

``zenoh_bus.ZenohBus`` is a real network, ``in_process.InProcessBus`` one within a process;
``tests/contract`` tests both.
"""

from collections.abc import Callable
from typing import Protocol

Answer = Callable[[bytes], bytes | None]
OnMessage = Callable[[bytes], None]
OnPresence = Callable[[str, bool], None]
# Of keys with a `*`: they get what stands for it, too.
AnswerEach = Callable[[str, bytes], bytes | None]
OnEach = Callable[[str, bytes], None]


class Bus(Protocol):
    """One peer's connection.

    Handlers run on threads of the bus, one message at a time per declaration. They must be quick.
    One that raises is logged, and goes on with the next message.
    """

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Ask the peer that answers ``key``.

        ``None``: nobody answers, the peer died, or ``timeout_s`` seconds went by. The question
        may have been read all the same.
        """
        ...

    def begin_asking(
        self, key: str, payload: bytes, timeout_s: float
    ) -> Callable[[], bytes | None]:
        """Ask, and wait for the answer later: by what is returned, which gives what `ask` gives.

        Questions to one key are read in their order, unless the connection breaks.
        """
        ...

    def fetch(self, key: str, timeout_s: float) -> bytes | None:
        """Ask with nothing for something large; all other messages go first, also later ones."""
        ...

    def answer(self, key: str, handler: Answer) -> None:
        """Answer the questions to ``key`` from now on; ``None`` is no answer."""
        ...

    def answer_in_turn(
        self, key: str, handler: Answer, refuse: Callable[[], bytes], at_most: int
    ) -> None:
        """Answer where the handler may take long: on a thread of its own.

        While ``at_most`` questions wait for their turn, any more are answered by ``refuse``.
        """
        ...

    def answer_each(self, key: str, handler: AnswerEach) -> None:
        """Answer the questions to all keys of this form, whose last part is ``*``."""
        ...

    def publish(self, key: str, payload: bytes) -> None:
        """Send to everybody who listens to ``key``; it may be lost."""
        ...

    def subscribe(self, key: str, handler: OnMessage) -> None:
        """Hear what is published on ``key`` from now on; ``*`` stands for one part of a key."""
        ...

    def subscribe_each(self, key: str, handler: OnEach) -> None:
        """Hear what is published on all keys of this form, whose last part is ``*``."""
        ...

    def declare_presence(self, key: str) -> None:
        """Be seen under ``key`` until this connection ends, however it ends."""
        ...

    def withdraw_presence(self, key: str) -> None:
        """No longer be seen under ``key``."""
        ...

    def watch_presence(self, key: str, handler: OnPresence) -> None:
        """Call ``handler(key, present)`` for all who are present, who come and who leave."""
        ...

    def present(self, key: str, timeout_s: float) -> list[str]:
        """Look who is present under ``key`` now."""
        ...

    def close(self) -> None:
        """End the connection; nothing is heard afterwards. May be called twice."""
        ...
