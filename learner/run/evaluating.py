"""Evaluation while training: when weights are evaluated, and what is done with the results."""

from collections.abc import Callable

import numpy as np

from a2s.learner.ingest.evaluations import Evaluated, Evaluations
from a2s.learner.run.directory import EPISODE_COLUMNS, EVALUATION_COLUMNS, RunDirectory
from a2s.learner.run.growing_table import column_of
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.status import Score, Status
from a2s.protocol.evaluation_messages import (
    MODES,
    EvaluationTask,
)

_MOST_SEEDS = 1 << 63
_COMING_S = 30.0  # for an evaluator that is still starting


class Evaluating:
    """Has the weights of a run evaluated, and writes down what came of it.

    The best policy by the mean action, of earlier starts as well, is kept in ``best/policy.onnx``.

    Attributes:
        earlier: The scores of earlier starts, by the mean action.
    """

    def __init__(
        self,
        evaluations: Evaluations,
        directory: RunDirectory,
        metrics: LearnerMetrics,
        status: Status,
    ) -> None:
        self._evaluations, self._directory = evaluations, directory
        self._metrics, self._status = metrics, status
        self._wanted = self._steps = 0
        rows = directory.read_evaluations("mean")
        self.earlier = [Score(each.env_steps, each.mean, each.std) for each in rows]
        self._known = {score.env_steps for score in self.earlier}
        for score in self.earlier:
            status.evaluated(score)

    def want(self, make_graph: Callable[[int, float], bytes]) -> None:
        """Have the present weights evaluated if it is time, on episodes that were never played."""
        status, run = self._status, self._status.run
        before, self._steps = max(self._steps, status.steps_at_start), status.env_steps
        every = run.evaluate_every
        is_due = every and self._steps // every > before // every
        if not is_due or self._steps in self._known:
            return
        self._wanted += 1
        task = EvaluationTask(
            generation=status.generation,
            number=self._wanted,
            env_steps=status.env_steps,
            weights_version=status.networks_version,
            modes=("mean",) if run.algo == "a2c" else MODES,
            episodes=run.evaluation_episodes,
            seed=(run.seed + status.env_steps) % _MOST_SEEDS,
            graph=make_graph(status.networks_version, status.fraction),
        )
        self._evaluations.want(task)

    def look(self, timeout_s: float = 0.0) -> None:
        """Write down the results that have come, or come in this time."""
        for evaluated in self._evaluations.take(timeout_s):
            self._write_down(evaluated)

    def awaits(self, waited_s: float) -> bool:
        """Whether the end of a run has to wait: for an evaluator at work, or a little for one."""
        is_early = waited_s < _COMING_S and self._evaluations.waiting > 0
        return is_early or self._evaluations.unfinished > 0

    def _write_down(self, evaluated: Evaluated) -> None:
        task, result = evaluated
        names = self._status.run.env_config().metric_names
        told = {each.name: each.value for each in result.metrics if each.name in names}
        for mode in task.modes:
            played = [episode for episode in result.episodes if episode.mode == mode]
            returns = [episode.episode_return for episode in played]
            score = Score(task.env_steps, float(np.mean(returns)), float(np.std(returns)))
            length = np.mean([episode.length for episode in played])
            shown = score.mean, score.std, min(returns), max(returns), length
            metrics = told if mode == "mean" else {}
            self._directory.evaluation(
                [task.env_steps, task.weights_version, mode, len(played)]
                + [f"{number:.9g}" for number in shown],
                {column_of(name, EVALUATION_COLUMNS): value for name, value in metrics.items()},
            )
            labels = {column_of(name, EPISODE_COLUMNS): v for name, v in metrics.items()}
            self._metrics.show_evaluation(mode, returns, labels)
            if mode == "mean" and self._status.evaluated(score):
                self._directory.policy("best", task.graph)
