"""How many of a kind are written down in a minute, so that peers fill no disk."""

from collections.abc import Hashable

FEW, MANY = 10, 600
_WINDOW_S = 60.0


class Allowance:
    """Counts what comes of each kind, and allows so many in a minute; there are few kinds."""

    def __init__(self) -> None:
        self._windows: dict[Hashable, tuple[float, int]] = {}  # its begin, how many came in it

    def take(self, kind: Hashable, most: int, now_s: float) -> int | None:
        """Take one more at ``now_s`` seconds: how many were left out before it, or ``None``.

        ``None``: this one is left out. Others are told of by the first one of the minute after.
        """
        begin_s, count = self._windows.get(kind, (now_s, 0))
        left_out = 0
        if now_s - begin_s >= _WINDOW_S:
            left_out = max(0, count - most)
            begin_s, count = now_s, 0
        self._windows[kind] = begin_s, count + 1
        return None if count >= most else left_out
