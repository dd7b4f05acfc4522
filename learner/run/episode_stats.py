"""Statistics of the episodes of a run so far."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from a2s.protocol.checks import MAX_METRICS

_WINDOW = 100
_RECENT = 10


@dataclass(slots=True)
class EpisodeStats:
    """Running statistics over finished episodes.

    Attributes:
        best: Greatest return so far.
        returns: Of the last 100 episodes.
        lengths: Of the last 100 episodes, in steps.
        metrics: The environments' metrics in their last 100 episodes, by name.
    """

    count: int = 0
    best: float | None = None
    returns: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    lengths: deque[int] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    metrics: dict[str, deque[float]] = field(default_factory=dict)

    def add(self, episode_return: float, length: int, metrics: Mapping[str, float]) -> None:
        """Count a finished episode."""
        self.count += 1
        self.best = episode_return if self.best is None else max(self.best, episode_return)
        self.returns.append(episode_return)
        self.lengths.append(length)
        for name, value in metrics.items():
            if name not in self.metrics and len(self.metrics) < MAX_METRICS:
                self.metrics[name] = deque(maxlen=_WINDOW)
            if name in self.metrics:
                self.metrics[name].append(value)

    @property
    def mean_metrics(self) -> dict[str, float]:
        """Means of `metrics`."""
        return {n: sum(v / len(values) for v in values) for n, values in self.metrics.items()}

    @property
    def mean_return(self) -> float | None:
        """Mean return of the last 100 episodes; ``None`` before the first."""
        return sum(self.returns) / len(self.returns) if self.returns else None

    @property
    def recent_return(self) -> float | None:
        """Mean return of the last 10 episodes; ``None`` before the first."""
        recent = list(self.returns)[-_RECENT:]
        return sum(recent) / len(recent) if recent else None
