"""Evaluation while training: when, and what is left of it."""

import csv
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from a2s.learner.ingest.evaluations import Evaluations
from a2s.learner.run.directory import EvaluationRow, RunDirectory, evaluations
from a2s.learner.run.evaluating import Evaluating
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.status import Score, Status
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.evaluation_messages import (
    EvaluatedEpisode,
    EvaluationRequest,
    EvaluationResult,
    EvaluationTask,
)
from a2s.protocol.messages import EpisodeMetric


class _Run:
    """A run in a directory, and an evaluator that is told what the episodes return."""

    def __init__(self, path: Path, steps_at_start: int = 0, **options: object) -> None:
        given = {"evaluate_every": 100, "evaluation_episodes": 2, "algo": "a2c", **options}
        self.status = Status(RunConfig(**RunConfig.parse(given)), generation=1)
        self.metrics, self.evaluations = LearnerMetrics(), Evaluations()
        self.directory = RunDirectory(path, ("update",), lambda: 1.5)
        self.evaluating = Evaluating(self.evaluations, self.directory, self.metrics, self.status)
        self.status.env_steps = self.status.steps_at_start = steps_at_start

    def reach(self, env_steps: int) -> None:
        """Learn up to there."""
        self.status.env_steps = env_steps
        self.evaluating.want(lambda version, fraction: f"graph {env_steps}".encode())

    def ask(self) -> EvaluationTask | None:
        """Take work as an evaluator."""
        self.evaluations.here("e")
        return self.evaluations.ask(EvaluationRequest(evaluator="e"))

    def play(self, *returns: float, **metrics: float) -> EvaluationTask:
        """Answer the next task, and let the learner look."""
        task = self.ask()
        assert task is not None
        each = max(1, len(returns) // len(task.modes))
        episodes = tuple(
            EvaluatedEpisode(mode=task.modes[i // each], episode_return=number, length=i + 1)
            for i, number in enumerate(returns)
        )
        self.evaluations.answer(
            EvaluationResult(
                evaluator="e",
                generation=1,
                number=task.number,
                episodes=episodes,
                metrics=tuple(EpisodeMetric(name=n, value=v) for n, v in metrics.items()),
            )
        )
        self.evaluating.look()
        return task


MakeRun = Callable[..., _Run]


@pytest.fixture
def make_run(tmp_path: Path) -> Iterator[MakeRun]:
    """Make a run in ``tmp_path``; its files are closed at the end."""
    with ExitStack() as stack:

        def make(**given: object) -> _Run:
            run = _Run(tmp_path, **given)  # type: ignore[arg-type]
            stack.enter_context(closing(run.directory))
            return run

        yield make


def test_weights_are_evaluated_when_the_steps_have_passed(make_run: MakeRun) -> None:
    """Not at once after a resume, nor twice for two multiples in one batch."""
    run = make_run(steps_at_start=150)
    for steps in (180, 205, 290, 530, 560):
        run.reach(steps)
    assert [run.play(0.0, 0.0).env_steps for _ in range(2)] == [205, 530]
    assert run.ask() is None


def test_without_an_interval_nothing_is_evaluated(tmp_path: Path, make_run: MakeRun) -> None:
    run = make_run(evaluate_every=0)
    run.reach(10_000)
    assert run.ask() is None
    assert not (tmp_path / "evaluations.csv").exists()


def test_every_evaluation_has_episodes_of_its_own(make_run: MakeRun) -> None:
    run = make_run(seed=5)
    for steps in (100, 200):
        run.reach(steps)
    first, second = run.play(0.0, 0.0), run.play(0.0, 0.0)
    assert (first.number, second.number) == (1, 2)
    assert first.seed != second.seed


def test_a_result_is_written_shown_and_the_best_policy_kept(
    tmp_path: Path, make_run: MakeRun
) -> None:
    run = make_run(algo="a2s")
    run.reach(100)
    run.play(1.0, 5.0, 30.0, 40.0)
    rows = (tmp_path / "evaluations.csv").read_text().splitlines()
    assert rows == [
        "wall_s,env_steps,weights_version,mode,episodes,return_mean,return_std,return_min,"
        "return_max,length_mean",
        "1.500,100,0,mean,2,3,2,1,5,1.5",
        "1.500,100,0,best-of-k,2,35,5,30,40,3.5",
    ]
    shown = run.metrics.registry.get_sample_value
    assert shown("a2s_learner_eval_return_mean") == 3.0
    assert shown("a2s_learner_eval_best_of_k_return_mean") == 35.0
    assert shown("a2s_learner_eval_episodes_total") == 4.0
    assert run.status.latest_score == Score(100, 3.0, 2.0)
    for steps, mean in ((200, 2.0), (300, 4.0), (400, 4.0)):
        run.reach(steps)
        run.play(mean, mean, 0.0, 0.0)
    assert run.status.best_score == Score(300, 4.0, 0.0)
    assert (tmp_path / "best" / "policy.onnx").read_bytes() == b"graph 300"


def test_metrics_of_the_environment_have_columns_from_the_first_evaluation_that_has_them(
    tmp_path: Path, make_run: MakeRun
) -> None:
    """Those that the run keeps, of the mean action; a name of ours is made another."""
    run = make_run(algo="a2s", info_metrics=["mode"])
    returns = (1.0, 1.0, 2.0, 2.0)
    for steps, told in ((100, {}), (200, {"is_success": 0.5, "other": 1.0}), (300, {"mode": 2.0})):
        run.reach(steps)
        run.play(*returns, **told)
    with (tmp_path / "evaluations.csv").open(newline="") as file:
        rows = [(r["mode"], r["is_success"], r["info_mode"]) for r in csv.DictReader(file)]
    others = ("best-of-k", "", "")
    assert rows == [
        ("mean", "", ""), others, ("mean", "0.5", ""), others, ("mean", "", "2"), others,
    ]  # fmt: skip
    assert [row.env_steps for row in evaluations(tmp_path, "mean")] == [100, 200, 300]
    shown = run.metrics.registry.get_sample_value
    assert shown("a2s_learner_eval_info_mean", {"metric": "is_success"}) == 0.5
    assert shown("a2s_learner_eval_info_mean", {"metric": "other"}) is None


def test_a_resumed_run_knows_the_best_of_its_earlier_starts(
    tmp_path: Path, make_run: MakeRun
) -> None:
    run = make_run()
    run.reach(100)
    run.play(7.0, 9.0)
    run.directory.close()
    run = make_run(steps_at_start=120, stop_at_return=8.0)
    assert run.status.best_score == Score(100, 8.0, 1.0)
    assert run.status.is_finished
    run.reach(200)
    run.play(7.0, 7.0)
    assert (tmp_path / "best" / "policy.onnx").read_bytes() == b"graph 100"
    rows = [EvaluationRow(1.5, 100, 8.0, 1.0), EvaluationRow(1.5, 200, 7.0, 0.0)]
    assert evaluations(tmp_path, "mean") == rows


@pytest.mark.parametrize("torn", ["1.5,200,2,mean,2,7,", "1.5,200,2,mean,2,7,1,6,8"])
def test_a_torn_row_is_forgotten(tmp_path: Path, make_run: MakeRun, torn: str) -> None:
    """As a full disk leaves it; what is evaluated next has its own line."""
    run = make_run()
    run.reach(100)
    run.play(7.0, 9.0)
    run.directory.close()
    with (tmp_path / "evaluations.csv").open("a") as file:
        file.write(torn)
    run = make_run(steps_at_start=120)
    assert run.status.best_score == Score(100, 8.0, 1.0)
    run.reach(300)
    run.play(6.0, 6.0)
    assert [row.env_steps for row in evaluations(tmp_path, "mean")] == [100, 300]


def test_a_damaged_table_is_named(tmp_path: Path, make_run: MakeRun) -> None:
    (tmp_path / "evaluations.csv").write_text("env_steps,mode\n1,mean\n")
    with pytest.raises(RunDirectoryError, match=r"evaluations.csv line 2: expected wall_s,"):
        make_run()


def test_a_run_ends_when_an_evaluation_is_as_good_as_was_wanted(make_run: MakeRun) -> None:
    run = make_run(stop_at_return=3.0)
    for steps, mean in ((100, 2.9), (200, 3.0)):
        assert not run.status.is_finished
        run.reach(steps)
        run.play(mean, mean)
    assert run.status.is_finished


def test_the_end_waits_a_little_for_an_evaluator_and_as_long_as_needed_for_its_work(
    make_run: MakeRun,
) -> None:
    run = make_run()
    assert not run.evaluating.awaits(0.0)
    run.reach(100)
    assert run.evaluating.awaits(29.0)
    assert not run.evaluating.awaits(31.0)
    assert run.ask() is not None
    assert run.evaluating.awaits(1000.0)
    run.play(0.0, 0.0)
    assert not run.evaluating.awaits(0.0)


def test_a_return_to_stop_at_needs_evaluations() -> None:
    with pytest.raises(UsageError, match=r"stop_at_return: only evaluations .* --evaluate-every"):
        RunConfig(stop_at_return=1.0)
