"""What limits a run: what most of the last seconds went into, at the learner and at its actors."""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from a2s.protocol.messages import ActorStatus

_WINDOW = 10  # looks
_EVERY_S = 1.0


class Shares(NamedTuple):
    """Shares of the last seconds, 0..1 each.

    Where learner and actors take turns they add up to 1; where they work at once, to more.

    Attributes:
        learner: It did not wait for a batch.
        environment: Environments were stepped, mean over the actors.
        selection: Actions were chosen, mean over the actors.
        network: Neither: messages were on their way, or somebody was waited for.
    """

    learner: float
    environment: float
    selection: float
    network: float

    @property
    def largest(self) -> str:
        """Name the largest."""
        return self._fields[self.index(max(self))]


class _Look(NamedTuple):
    now_s: float
    learning_s: float
    actors: dict[str, tuple[float, float]]  # seconds in environments and selection, by name


class Limits:
    """Looks at the counts of learner and actors about once a second, and compares the last ten.

    Attributes:
        shares: Since the oldest look at an actor that is still there; ``None`` while unknown.
    """

    def __init__(self) -> None:
        self._looks: deque[_Look] = deque(maxlen=_WINDOW)
        self.shares: Shares | None = None

    def look(self, now_s: float, learning_s: float, actors: Iterable[ActorStatus]) -> bool:
        """Take counts into account if it is time to, and say so.

        They are in seconds so far, and ``now_s`` is on any clock.
        """
        if self._looks and now_s - self._looks[-1].now_s < _EVERY_S:
            return False
        spent = {each.actor: (each.environment_s, each.selection_s) for each in actors}
        last = _Look(now_s, learning_s, spent)
        known = (each for each in self._looks if each.actors.keys() & spent.keys())
        self.shares = _compare(next(known, last), last)
        self._looks.append(last)
        return True


def _compare(first: _Look, last: _Look) -> Shares | None:
    """Shares between two looks; ``None`` between a look and itself."""
    if first is last:
        return None
    both = first.actors.keys() & last.actors.keys()
    seconds = last.now_s - first.now_s
    means = [
        sum(last.actors[name][part] - first.actors[name][part] for name in both) / len(both)
        for part in (0, 1)
    ]
    # What is learned is counted when it is done, and may have begun before the first look.
    learner = min(1.0, (last.learning_s - first.learning_s) / seconds)
    environment, selection = (mean / seconds for mean in means)
    network = max(0.0, 1.0 - learner - environment - selection)
    return Shares(learner, environment, selection, network)
