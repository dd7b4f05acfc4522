"""Non-fatal troubles of an environment: always counted, rarely reported."""

import logging

logger = logging.getLogger(__name__)


class Troubles:
    """Counts troubles; reports the 1st, 2nd, 4th, 8th and so on of each kind.

    Attributes:
        dropped_steps: Steps that could not be used.
        latest: The latest trouble in one line; empty if there was no trouble.
    """

    def __init__(self) -> None:
        self.dropped_steps = 0
        self.latest = ""
        self._drops = 0
        self._cuts = 0

    def dropped(self, env_id: str, what: str, steps: int) -> None:
        """Note that steps were dropped because of ``what``."""
        self.dropped_steps += steps
        self._drops += 1
        plural = "" if self.dropped_steps == 1 else "s"
        self._say(
            f"environment {env_id}: {what}, {self.dropped_steps} transition{plural} dropped",
            self._drops,
        )

    def cut(self, env_id: str, steps: int) -> None:
        """Note that an episode without an end was cut."""
        self._cuts += 1
        self._say(
            f"environment {env_id}: an episode had not ended after {steps:,} steps and was cut; "
            "--max-episode-steps sets the limit",
            self._cuts,
        )

    def _say(self, words: str, times: int) -> None:
        self.latest = words
        if times & (times - 1) == 0:
            logger.warning("%s", words)
