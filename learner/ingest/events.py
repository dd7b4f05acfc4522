"""Events that peers cause, at a rate that fills no disk."""

from collections.abc import Callable

_WINDOW_S = 60.0
_FEW, _MANY = 10, 600
_MOST = {"refusal": _FEW, "trouble": _MANY, "join": _MANY, "leave": _MANY, "restart": _MANY}


class Events:
    """Passes events on: of a cause 10 refusals in a minute, of the others 600 of a kind.

    The first one of the minute after says how many were ``left_out``. ``clock`` gives seconds.
    """

    def __init__(self, on_event: Callable[..., None], clock: Callable[[], float]) -> None:
        self._on_event, self._clock = on_event, clock
        self._windows: dict[tuple[str, str], tuple[float, int]] = {}  # its begin, events in it

    def __call__(self, kind: str, cause: str = "", **details: object) -> bool:
        """Pass an event on, unless there were too many; there are few causes of a kind."""
        now_s, most = self._clock(), _MOST[kind]
        begin_s, count = self._windows.get((kind, cause), (now_s, 0))
        if now_s - begin_s >= _WINDOW_S:
            if count > most:
                details["left_out"] = count - most
            begin_s, count = now_s, 0
        self._windows[kind, cause] = begin_s, count + 1
        if count >= most:
            return False
        self._on_event(kind, **details)
        return True
