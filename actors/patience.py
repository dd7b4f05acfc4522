"""A wait that is said aloud."""

import logging
from collections.abc import Callable
from time import monotonic

from a2s.protocol.codec import decode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.identity import not_heard
from a2s.protocol.keys import Keys, other_runs
from a2s.protocol.messages import RunStatus
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

_SAID_EVERY_S = 10.0
_ASK_TIMEOUT_S = 1.0


class Patience:
    """Says every ten seconds what a process still waits for.

    When the run has ended, that is said once, by the first worker alone (``speaks``), and no more:
    nobody has to start anything. ``known_as`` is the name that a learner may not let in.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        *,
        speaks: bool,
        known_as: str = "",
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self._bus, self._keys, self._speaks, self._clock = bus, keys, speaks, clock
        self._help = not_heard("is `a2s learner` running", known_as)
        self._since_s: float | None = None
        self._said_s = 0.0
        self._run_ended = self._has_waited_since = False
        bus.subscribe(keys.status, self._hear)

    def over(self) -> None:
        """The wait is over."""
        self._since_s = None
        if self._has_waited_since:  # an answer that came with the end is no sign of another learner
            self._run_ended = self._has_waited_since = False

    def wait_for(self, what: str) -> None:
        """Say it if it is time; to be called again and again while the wait lasts."""
        now_s = self._clock()
        if self._run_ended:
            self._has_waited_since = True
        elif self._since_s is None:
            self._since_s = self._said_s = now_s
        elif now_s - self._said_s >= _SAID_EVERY_S:
            self._said_s = now_s
            hint = self._asked() or other_runs(self._bus, self._keys.run) or f"; {self._help}"
            logger.warning("waiting for %s for %.0f s%s", what, now_s - self._since_s, hint)

    def _asked(self) -> str:
        """What the learner itself waits for, if it answers at all."""
        answer = self._bus.ask(self._keys.status, b"", _ASK_TIMEOUT_S)
        if answer is None:
            return ""
        try:
            told = decode(answer, RunStatus)
        except MalformedMessageError:  # it says nothing that would help
            return ""
        assert isinstance(told, RunStatus)
        return f"; it answers, and waits for {told.waiting_for}" if told.waiting_for else ""

    def _hear(self, payload: bytes) -> None:
        """Take what the learner says of itself unasked: that the run has ended."""
        told = decode(payload, RunStatus)
        assert isinstance(told, RunStatus)
        if told.ended and not self._run_ended:
            self._run_ended = True
            if self._speaks:
                logger.warning(
                    "run %r has ended: %s; waiting for a learner that goes on with it, or for a "
                    "new run", self._keys.run, told.ended,
                )  # fmt: skip
