"""What a child prints: bytes of any kind, as lines, and no more of them than can be read."""

import math
import time
from collections.abc import Callable

_LONGEST_LINE = 4096
_WINDOW_S = 10.0
_MOST_LINES = 1000  # in a window


class Lines:
    """Cuts bytes into lines, whatever they are."""

    def __init__(self, on_line: Callable[[str], None], longest: float = math.inf) -> None:
        self._on_line, self._longest = on_line, longest
        self._rest = b""

    def feed(self, data: bytes) -> None:
        """Take the next bytes; none are the end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if not data or len(self._rest) > self._longest:
            lines.append(self._rest)
            self._rest = b""
        for line in lines:
            if line:
                self._on_line(line.decode(errors="replace").rstrip("\r"))


class Words:
    """Lines that are shown to a user: those of a flood are counted instead.

    Args:
        on_line: Told each.
    """

    def __init__(self, on_line: Callable[[str], None]) -> None:
        self._on_line = on_line
        self._lines = Lines(self._take, _LONGEST_LINE)
        self._shown, self._hidden = 0, 0
        self._since_s = time.monotonic()

    def feed(self, data: bytes) -> None:
        """Take the next bytes; none are the end."""
        self._lines.feed(data)
        if not data:
            self._begin_window()

    def _take(self, line: str) -> None:
        if time.monotonic() - self._since_s > _WINDOW_S:
            self._begin_window()
        self._shown += 1
        if self._shown <= _MOST_LINES:
            self._on_line(line[:_LONGEST_LINE])
        else:
            self._hidden += 1

    def _begin_window(self) -> None:
        if self._hidden:
            self._on_line(f"... {self._hidden:,} lines more within {_WINDOW_S:.0f} s are not shown")
        self._shown, self._hidden, self._since_s = 0, 0, time.monotonic()
