"""Who has said hello and not joined yet: actors that are making their environments."""

from dataclasses import dataclass

_MOST = 4096
_GONE_S = 30.0


@dataclass(slots=True)
class _Newcomer:
    first_s: float
    heard_s: float
    doing: str = ""


class Newcomers:
    """Remembers them for as long as they are heard. Not thread-safe: its owner has the lock."""

    def __init__(self) -> None:
        self._known: dict[str, _Newcomer] = {}

    def hear(self, actor: str, now_s: float, doing: str = "") -> None:
        """Take note of a hello or a status of one that is no member."""
        known = self._known.setdefault(actor, _Newcomer(first_s=now_s, heard_s=now_s))
        known.heard_s, known.doing = now_s, doing
        if len(self._known) > _MOST:
            del self._known[next(iter(self._known))]

    def forget(self, actor: str) -> None:
        """It has joined, or is gone."""
        self._known.pop(actor, None)

    def describe(self, now_s: float) -> str:
        """Say who is coming and what keeps the first of them; empty if nobody is."""
        coming = {a: n for a, n in self._known.items() if now_s - n.heard_s < _GONE_S}
        self._known = coming
        if not coming:
            return ""
        actor, first = next(iter(coming.items()))
        doing = first.doing or f"making its environments for {now_s - first.first_s:.0f} s"
        others = f" and {len(coming) - 1} more" if len(coming) > 1 else ""
        return f"{actor}{others}: {doing}"
