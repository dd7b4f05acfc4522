"""A wait that is said aloud."""

import logging
from time import monotonic

logger = logging.getLogger(__name__)

_SAID_EVERY_S = 10.0


class Patience:
    """Says every ten seconds what a process still waits for."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._said_s = 0.0

    def over(self) -> None:
        """The wait is over."""
        self._since_s = None

    def wait_for(self, what: str) -> None:
        """Say it if it is time; to be called again and again while the wait lasts."""
        now_s = monotonic()
        if self._since_s is None:
            self._since_s = self._said_s = now_s
        elif now_s - self._said_s >= _SAID_EVERY_S:
            self._said_s = now_s
            logger.warning(
                "waiting for %s for %.0f s; is `a2s learner` running?", what, now_s - self._since_s
            )
