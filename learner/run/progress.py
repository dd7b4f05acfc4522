"""A run in the terminal: a live display, or plain lines where it is not a terminal."""

import sys
import time
from collections.abc import Iterable, Sequence
from typing import Protocol, TextIO

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from a2s.learner.ingest.members import Member
from a2s.learner.numerals import written
from a2s.learner.run.actor_table import ActorTable
from a2s.learner.run.limits import Shares
from a2s.learner.run.run_config import COUNTED
from a2s.learner.run.status import Status

_BARS = " ▁▂▃▄▅▆▇█"
_CURVE_POINTS = 60
_LIVE_EVERY_S = 0.25
_LINE_EVERY_S = 5.0
_PATIENCE_S = 3.0


class View(Protocol):
    """Shows progress; called often, draws as often as is useful."""

    def show(self, status: Status, members: Sequence[Member], kl: float | None) -> None:
        """Take the newest status, the actors present, and the KL divergence of a new update."""
        ...

    def close(self) -> None:
        """Draw no more."""
        ...


class PlainView:
    """One line every few seconds, for logs and pipes."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._written_s = 0.0
        self._steps = 0

    def show(self, status: Status, members: Sequence[Member], kl: float | None) -> None:
        """Write a line if it is time to."""
        now_s, steps = time.monotonic(), status.env_steps
        if now_s - self._written_s < _LINE_EVERY_S:
            return
        rate = (steps - self._steps) / (now_s - self._written_s) if self._written_s else 0.0
        self._written_s, self._steps = now_s, steps
        episodes = status.episodes
        line = (
            f"steps={steps} steps_per_s={rate:.0f} "
            f"return={_number(episodes.mean_return)} best={_number(episodes.best)} "
            f"episodes={episodes.count} version={status.version} "
            f"recoveries={status.num_recoveries} actors={len(members)}"
        )
        if score := status.latest_score:
            line += f" evaluation={written(score.mean)}"
        line += "".join(f" {name}={mean:.3g}" for name, mean in episodes.mean_metrics.items())
        shares = status.limits.shares
        line += f" limited_by={shares.largest}" if shares else ""
        line += f" waiting_for={status.waiting_for!r}" if status.waiting_for else ""
        self._out.write(line + "\n")
        self._out.flush()

    def close(self) -> None:
        """Nothing to put back."""


class _Display(Progress):
    """A bar with lines of text below it, and a table of actors where there are any."""

    lines: tuple[str, ...] = ()
    actors: Table | None = None

    def get_renderables(self) -> Iterable[RenderableType]:
        yield from super().get_renderables()
        yield Text("\n".join(self.lines))
        if self.actors is not None:
            yield self.actors


class LiveView:
    """A bar, the curve of returns, the numbers and the actors, redrawn in place."""

    def __init__(self, console: Console, title: str) -> None:
        self._title = escape(title)
        self._display = _Display(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} steps"),
            TextColumn("{task.fields[rate]:,.0f} steps/s"),
            TimeRemainingColumn(),
            console=console,
            auto_refresh=False,
        )
        self._actors = ActorTable()
        self._task: TaskID | None = None
        self._drawn_s = 0.0
        self._waiting_since_s: float | None = None
        self._curve: list[float] = []
        self._rows = 0

    def show(self, status: Status, members: Sequence[Member], kl: float | None) -> None:
        """Redraw if it is time to."""
        now_s, display = time.monotonic(), self._display
        if not status.waiting_for or self._waiting_since_s is None:
            self._waiting_since_s = now_s
        if now_s - self._drawn_s < _LIVE_EVERY_S:
            return
        self._drawn_s = now_s
        mean = status.episodes.mean_return
        if mean is not None and status.rows != self._rows:
            self._curve, self._rows = thin([*self._curve, mean]), status.rows
        done, total = status.env_steps, status.run.total_steps
        if self._task is None:
            display.start()
            self._task = display.add_task(self._title, total=total, completed=done, rate=0.0)
        display.update(self._task, completed=done, rate=display.tasks[0].speed or 0.0)
        waited_s = now_s - self._waiting_since_s
        display.lines = (sparkline(self._curve), *_lines(status, members, kl, waited_s))
        display.actors = self._actors.draw(members, status.version, now_s)
        display.refresh()

    def close(self) -> None:
        """Leave the last picture and give the terminal back."""
        self._display.stop()


def make_view(title: str, *, quiet: bool) -> View:
    """Choose how to show progress: live on a terminal, plain lines elsewhere.

    With ``quiet`` it writes to standard error, since standard output is used for something else.
    """
    out = sys.stderr if quiet else sys.stdout
    return LiveView(Console(file=out), title) if out.isatty() else PlainView(out)


def _lines(
    status: Status, members: Sequence[Member], kl: float | None, waited_s: float
) -> Iterable[str]:
    episodes = status.episodes
    num_envs = sum(member.num_envs for member in members)
    yield (
        f"return {_number(episodes.mean_return)}  best {_number(episodes.best)}  "
        f"episodes {episodes.count:,}  {COUNTED[status.run.variant]} {status.updates:,}"
        + ("" if kl is None else f"  KL {kl:.4f}")
    )
    if score := status.latest_score:
        found = f"{written(score.mean)} +- {written(score.std)}"
        yield f"evaluation {found} at {score.env_steps:,} steps"
    if shares := status.limits.shares:
        yield limits_line(shares)
    yield (
        f"actors {len(members)} with {num_envs} environments  version {status.version}  "
        f"recoveries {status.num_recoveries}"
    )
    if metrics := episodes.mean_metrics:
        yield "  ".join(f"{name} {mean:.3g}" for name, mean in [*metrics.items()][:3])
    if status.waiting_for and waited_s > _PATIENCE_S:
        yield f"waiting {waited_s:.0f} s for {status.waiting_for}"


def limits_line(shares: Shares) -> str:
    """Name what limits the run, and the shares."""
    parts = ", ".join(f"{name} {share:.0%}" for name, share in shares._asdict().items())
    return f"limited by {shares.largest}: {parts} of the time"


def thin(curve: list[float]) -> list[float]:
    """Halve a curve that has become too long, keeping its last point."""
    return curve if len(curve) <= _CURVE_POINTS else curve[::-2][::-1]


def sparkline(curve: Sequence[float]) -> str:
    """Draw a curve in one line of blocks."""
    low, high = min(curve, default=0.0), max(curve, default=0.0)
    scale = (len(_BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BARS[round((point - low) * scale)] for point in curve)


def _number(value: float | None) -> str:
    return "-" if value is None else written(value)
