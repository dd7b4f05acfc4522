"""What limits a run: what most of the last seconds went into, at the learner and at its actors."""

from collections import deque
from collections.abc import Sequence
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
    """Looks at the counts of learner and actors about once a second, and compares the last ten."""

    def __init__(self) -> None:
        self._looks: deque[_Look] = deque(maxlen=_WINDOW)

    def look(self, now_s: float, learning_s: float, actors: Sequence[ActorStatus]) -> None:
        """Take counts into account if it is time to: seconds so far, and now on any clock."""
        if self._looks and now_s - self._looks[-1].now_s < _EVERY_S:
            return
        spent = {each.actor: (each.environment_s, each.selection_s) for each in actors}
        self._looks.append(_Look(now_s, learning_s, spent))

    def shares(self) -> Shares | None:
        """The shares since the oldest look at an actor that is still there; ``None``: unknown."""
        looks = list(self._looks)  # at once: others ask, too
        known = (each for each in looks[:-1] if each.actors.keys() & looks[-1].actors.keys())
        first = next(known, None)
        if first is None:
            return None
        last = looks[-1]
        both = first.actors.keys() & last.actors.keys()
        seconds = last.now_s - first.now_s
        means = [
            sum(last.actors[name][part] - first.actors[name][part] for name in both) / len(both)
            for part in (0, 1)
        ]
        learner = (last.learning_s - first.learning_s) / seconds
        environment, selection = (mean / seconds for mean in means)
        network = max(0.0, 1.0 - learner - environment - selection)
        return Shares(learner, environment, selection, network)
