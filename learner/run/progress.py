"""How a run shows itself in the terminal: a live picture, or plain lines where there is none."""

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from a2s.learner.numerals import written

_BARS = " ▁▂▃▄▅▆▇█"
_CURVE_POINTS = 60
_LIVE_EVERY_S = 0.25
_LINE_EVERY_S = 5.0
_PATIENCE_S = 3.0
_RATE_WINDOW_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where a run stands.

    Attributes:
        env_steps: Environment steps taken into batches, and all accepted before a restart.
        total_steps: Where the run ends.
        episodes: Finished episodes.
        return_mean: Of the last 100 episodes; ``None`` before the first.
        return_best: Best episode so far.
        updates: Batches learned from.
        weights_version: Newest version.
        recoveries: Returns to the best networks.
        actors: Present.
        num_envs: Environments of all of them.
        waiting_for: What the learner waits for; empty while it learns.
        wall_s: Seconds since the run began.
        kl: KL divergence of the latest update; ``None`` while waiting.
        info: Means of what environments told of the last 100 episodes, by name.
    """

    env_steps: int
    total_steps: int
    episodes: int
    return_mean: float | None
    return_best: float | None
    updates: int
    weights_version: int
    recoveries: int
    actors: int
    num_envs: int
    waiting_for: str
    wall_s: float
    kl: float | None
    info: Mapping[str, float] = field(default_factory=dict)


class View(Protocol):
    """Shows progress; called often, draws as often as is useful."""

    def show(self, progress: Progress) -> None:
        """Take the newest progress."""
        ...

    def close(self) -> None:
        """Draw no more."""
        ...


class _Rate:
    """Steps per second over the last ten seconds."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, int]] = deque()

    def of(self, progress: Progress) -> float:
        points = self._points
        points.append((progress.wall_s, progress.env_steps))
        while len(points) > 2 and points[-1][0] - points[0][0] > _RATE_WINDOW_S:
            points.popleft()
        seconds = points[-1][0] - points[0][0]
        return (points[-1][1] - points[0][1]) / seconds if seconds > 0 else 0.0


class PlainView:
    """One line every few seconds, for logs and pipes."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._rate = _Rate()
        self._last_s = 0.0

    def show(self, progress: Progress) -> None:
        """Write a line if it is time to."""
        now_s = time.monotonic()
        rate = self._rate.of(progress)
        if now_s - self._last_s < _LINE_EVERY_S:
            return
        self._last_s = now_s
        self._out.write(describe(progress, rate) + "\n")
        self._out.flush()

    def close(self) -> None:
        """Nothing to put back."""


class LiveView:
    """A bar, a curve and the numbers, redrawn in place.

    Args:
        console: Where to draw.
        title: What runs.
    """

    def __init__(self, console: Console, title: str) -> None:
        self._title = title
        self._rate = _Rate()
        self._curve: list[float] = []
        self._episodes = 0
        self._last_s = 0.0
        self._waiting_since_s: float | None = None
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._live.start()

    def show(self, progress: Progress) -> None:
        """Redraw if it is time to."""
        rate = self._rate.of(progress)
        if progress.return_mean is not None and progress.episodes > self._episodes:
            self._episodes = progress.episodes
            self._curve = thin([*self._curve, progress.return_mean])
        now_s = time.monotonic()
        if not progress.waiting_for or self._waiting_since_s is None:
            self._waiting_since_s = now_s
        if now_s - self._last_s >= _LIVE_EVERY_S:
            self._last_s = now_s
            waited_s = now_s - self._waiting_since_s
            self._live.update(self._draw(progress, rate, waited_s), refresh=True)

    def close(self) -> None:
        """Leave the last picture and give the terminal back."""
        self._live.stop()

    def _draw(self, progress: Progress, rate: float, waited_s: float) -> Group:
        bar = Table.grid()
        bar.add_row(ProgressBar(progress.total_steps, progress.env_steps, width=_CURVE_POINTS))
        left = progress.total_steps - progress.env_steps
        ends = f"{_duration(left / rate)} left" if rate > 0 and left > 0 else ""
        table = Table.grid(padding=(0, 3))
        table.add_row(
            f"steps {progress.env_steps:,} of {progress.total_steps:,}",
            f"{rate:,.0f} steps/s",
            f"{_duration(progress.wall_s)} {ends}",
        )
        table.add_row(
            f"return {_number(progress.return_mean)} best {_number(progress.return_best)}",
            f"episodes {progress.episodes:,}",
            f"updates {progress.updates:,} recoveries {progress.recoveries}",
        )
        table.add_row(
            f"actors {progress.actors} with {progress.num_envs} environments",
            f"version {progress.weights_version}",
            "" if progress.kl is None else f"KL {progress.kl:.4f}",
        )
        if progress.info:
            table.add_row(*(f"{name} {mean:.3g}" for name, mean in list(progress.info.items())[:3]))
        lines: list[RenderableType] = [Text(self._title, style="bold"), bar, table]
        lines.append(Text(sparkline(self._curve)))
        if progress.waiting_for and waited_s > _PATIENCE_S:
            waiting = f"waiting {waited_s:.0f} s for {progress.waiting_for}"
            lines.append(Text(waiting, style="yellow"))
        return Group(*lines)


def make_view(title: str, *, quiet: bool) -> View:
    """Choose how to show progress: live on a terminal, plain lines elsewhere.

    Args:
        title: What runs.
        quiet: Standard output is wanted for something else: write to standard error.
    """
    out = sys.stderr if quiet else sys.stdout
    return LiveView(Console(file=out), title) if out.isatty() else PlainView(out)


def describe(progress: Progress, rate: float) -> str:
    """Say where a run stands in one line."""
    line = (
        f"steps={progress.env_steps} steps_per_s={rate:.0f} "
        f"return={_number(progress.return_mean)} best={_number(progress.return_best)} "
        f"episodes={progress.episodes} version={progress.weights_version} "
        f"recoveries={progress.recoveries} actors={progress.actors}"
    )
    line += "".join(f" {name}={mean:.3g}" for name, mean in progress.info.items())
    return f"{line} waiting_for={progress.waiting_for!r}" if progress.waiting_for else line


def thin(points: list[float]) -> list[float]:
    """Halve a curve that has become too long, keeping its last point."""
    return points if len(points) <= 2 * _CURVE_POINTS else points[1::2]


def sparkline(points: list[float]) -> str:
    """Draw a curve in one line of blocks."""
    shown = points[-_CURVE_POINTS:] if len(points) <= _CURVE_POINTS else points[::2]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    scale = (len(_BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BARS[round((point - low) * scale)] for point in shown)


def _number(value: float | None) -> str:
    return "-" if value is None else written(value)


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
