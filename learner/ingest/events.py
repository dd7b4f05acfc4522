"""Events that peers cause, at a rate that fills no disk."""

from collections.abc import Callable

from a2s.protocol.allowance import FEW, MANY, Allowance

_MOST = {"refusal": FEW, "trouble": MANY, "join": MANY, "leave": MANY, "restart": MANY}


class Events:
    """Passes events on: of a cause 10 refusals in a minute, of the others 600 of a kind.

    The first one of the minute after says how many were ``left_out``. ``clock`` gives seconds.
    """

    def __init__(self, on_event: Callable[..., None], clock: Callable[[], float]) -> None:
        self._on_event, self._clock, self._allowance = on_event, clock, Allowance()

    def __call__(self, kind: str, cause: str = "", **details: object) -> bool:
        """Pass an event on, unless there were too many; there are few causes of a kind."""
        left_out = self._allowance.take((kind, cause), _MOST[kind], self._clock())
        if left_out is None:
            return False
        if left_out:
            details["left_out"] = left_out
        self._on_event(kind, **details)
        return True
