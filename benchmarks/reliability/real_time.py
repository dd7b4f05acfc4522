"""A wrapper that makes a simulation as slow as the world."""

import time
from typing import Any, SupportsFloat

import gymnasium


class RealTime(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends a step when the time that it simulates, ``dt`` of MuJoCo environments, has gone by.

    Time that was lost is not made up for.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._dt_s = float(env.unwrapped.dt)  # type: ignore[attr-defined]
        self._due_s = 0.0

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, then wait."""
        found = super().step(action)
        now_s = time.monotonic()
        self._due_s = max(self._due_s + self._dt_s, now_s)
        time.sleep(self._due_s - now_s)
        return found
