"""Finished episodes, written down."""

from a2s.learner.feed import Episode
from a2s.learner.run.directory import EPISODE_COLUMNS, RunDirectory
from a2s.learner.run.episode_stats import EpisodeStats
from a2s.learner.run.growing_table import column_of
from a2s.learner.run.metrics import LearnerMetrics


class EpisodeLog:
    """Writes a row for every finished episode, adds it to ``stats`` and counts it.

    ``metric_names`` are the environment's metrics to keep.
    """

    def __init__(
        self,
        stats: EpisodeStats,
        directory: RunDirectory,
        metrics: LearnerMetrics,
        metric_names: tuple[str, ...],
    ) -> None:
        self._stats, self._directory, self._metrics = stats, directory, metrics
        self._metric_names = metric_names

    def add(self, episode: Episode, slot: int, env_steps: int) -> None:
        """Write down an episode of the actor at a place, at this number of steps of the run."""
        told = {n: value for n, value in episode.metrics.items() if n in self._metric_names}
        metrics = {column_of(n, EPISODE_COLUMNS): value for n, value in told.items()}
        self._stats.add(episode.episode_return, episode.length, metrics)
        self._metrics.episodes.inc()
        row = (
            env_steps,
            slot,
            episode.weights_version,
            f"{episode.episode_return:.9g}",
            episode.length,
            int(episode.terminated),
        )
        self._directory.episode(row, metrics)
