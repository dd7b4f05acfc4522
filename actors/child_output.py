"""The output of a child: bytes of any kind, cut into lines, with floods limited."""

import math
import time
from collections.abc import Callable

_MAX_LINE_BYTES = 4096
_WINDOW_S = 10.0
_MAX_LINES = 1000  # in a window


class Lines:
    """Cuts bytes into lines, whatever they are; one that grows too long is cut as well."""

    def __init__(self, on_line: Callable[[str], None], max_bytes: float = math.inf) -> None:
        self._on_line, self._max_bytes = on_line, max_bytes
        self._rest = b""

    def feed(self, data: bytes) -> None:
        """Take the next bytes; empty at the end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if not data or len(self._rest) > self._max_bytes:
            lines.append(self._rest)
            self._rest = b""
        for line in lines:
            if line:
                self._on_line(line.decode(errors="replace").rstrip("\r"))


class Words(Lines):
    """Lines that are shown to a user: those of a flood are counted instead."""

    def __init__(self, on_line: Callable[[str], None]) -> None:
        super().__init__(self._take, _MAX_LINE_BYTES)
        self._show = on_line
        self._shown, self._hidden = 0, 0
        self._since_s = time.monotonic()

    def feed(self, data: bytes) -> None:
        """Take the next bytes; empty at the end."""
        super().feed(data)
        if not data:
            self._begin_window()

    def _take(self, line: str) -> None:
        if time.monotonic() - self._since_s > _WINDOW_S:
            self._begin_window()
        self._shown += 1
        if self._shown <= _MAX_LINES:
            self._show(line[:_MAX_LINE_BYTES])
        else:
            self._hidden += 1

    def _begin_window(self) -> None:
        if self._hidden:
            self._show(f"... {self._hidden:,} lines more within {_WINDOW_S:.0f} s are not shown")
        self._shown, self._hidden, self._since_s = 0, 0, time.monotonic()
