"""The table of actors in the terminal."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from a2s.learner.ingest.members import Member
from a2s.protocol.messages import ActorStatus

_MOST_ROWS = 8
_WINDOW_S = 5.0  # of the rate
_SILENT_S = 10.0
_QUICK, _PLAYS = " for 0 s", "plays"


class _Look(NamedTuple):
    now_s: float
    status: ActorStatus


class ActorTable:
    """How fast each actor plays, how old its weights are and what it does.

    At most eight rows, those that do not simply play first.
    """

    def __init__(self) -> None:
        self._looks: dict[str, deque[_Look]] = {}

    def draw(self, members: Sequence[Member], version: int, now_s: float) -> Table | None:
        """Draw it; ``None`` without actors. ``now_s`` is on the clock of ``heard_s``."""
        self._looks = {m.actor: self._looks.get(m.actor, deque()) for m in members}
        if not members:
            return None
        table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
        table.add_column("actor", no_wrap=True)
        table.add_column("steps/s", justify="right", no_wrap=True)
        table.add_column("behind", justify="right", no_wrap=True)
        table.add_column("state", no_wrap=True)
        rows = []
        for member in members:
            state = _state(member, now_s)
            rows.append((state == _PLAYS, member.slot, self._row(member, version, now_s), state))
        for *_, cells, state in sorted(rows)[:_MOST_ROWS]:
            table.add_row(*cells, Text(state))  # an actor's words are no markup
        if len(rows) > _MOST_ROWS:
            table.add_row(f"and {len(rows) - _MOST_ROWS} more")
        return table

    def _row(self, member: Member, version: int, now_s: float) -> tuple[str, str, str]:
        status, looks = member.status, self._looks[member.actor]
        if status is None:
            return member.actor, "-", "-"
        if not looks or status is not looks[-1].status:
            looks.append(_Look(now_s, status))
        while len(looks) > 2 and now_s - looks[0].now_s > _WINDOW_S:
            looks.popleft()
        first, last = looks[0], looks[-1]
        steps, seconds = last.status.env_steps - first.status.env_steps, last.now_s - first.now_s
        rate = f"{steps / seconds:,.0f}" if seconds > 0 else "-"
        return member.actor, rate, f"{max(0, version - status.weights_version):,}"


def _state(member: Member, now_s: float) -> str:
    silent_s = now_s - member.heard_s
    if silent_s > _SILENT_S:
        return f"silent for {silent_s:.0f} s"
    if member.status is None:
        return "has joined"
    doing = member.status.doing
    return doing if doing and not doing.endswith(_QUICK) else _PLAYS
