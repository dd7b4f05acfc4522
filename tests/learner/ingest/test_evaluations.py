"""Evaluations: every task is answered once, whoever leaves in between."""

from collections.abc import Sequence

import pytest

from a2s.learner.ingest.evaluations import MAX_WAITING, Evaluations
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import (
    MODES,
    EvaluatedEpisode,
    EvaluationMode,
    EvaluationRequest,
    EvaluationResult,
    EvaluationTask,
)


def _task(number: int, modes: tuple[EvaluationMode, ...] = ("mean",)) -> EvaluationTask:
    return EvaluationTask(
        generation=1, number=number, env_steps=100 * number, weights_version=number, modes=modes,
        episodes=2, seed=0, graph=b"graph",
    )  # fmt: skip


def _result(
    evaluator: str, number: int, modes: Sequence[EvaluationMode] = ("mean", "mean")
) -> EvaluationResult:
    episodes = tuple(EvaluatedEpisode(mode=mode, episode_return=1.0, length=3) for mode in modes)
    return EvaluationResult(evaluator=evaluator, generation=1, number=number, episodes=episodes)


def _ask(evaluations: Evaluations, evaluator: str) -> int | None:
    evaluations.here(evaluator)
    task = evaluations.ask(EvaluationRequest(evaluator=evaluator))
    return None if task is None else task.number


def _numbers(evaluations: Evaluations) -> list[int]:
    return [task.number for task, _ in evaluations.take()]


def test_a_task_is_given_again_until_it_is_answered() -> None:
    """An answer may be lost, in either direction."""
    evaluations = Evaluations()
    evaluations.want(_task(1))
    evaluations.want(_task(2))
    assert [_ask(evaluations, "a"), _ask(evaluations, "a"), _ask(evaluations, "b")] == [1, 1, 2]
    evaluations.answer(_result("a", 1))
    evaluations.answer(_result("a", 1))
    assert _ask(evaluations, "a") is None
    assert _numbers(evaluations) == [1]
    assert evaluations.unfinished == 1


def test_who_leaves_gives_its_task_to_the_next() -> None:
    evaluations = Evaluations()
    evaluations.want(_task(1))
    evaluations.want(_task(2))
    assert _ask(evaluations, "a") == 1
    evaluations.gone("a")
    evaluations.gone("somebody else")
    evaluations.answer(_result("a", 1))  # came too late: it is another's by now
    assert [_ask(evaluations, "b"), evaluations.unfinished] == [1, 2]
    assert _numbers(evaluations) == []


def test_who_cannot_be_seen_gets_no_work() -> None:
    """Nobody would see it leave with its task."""
    evaluations = Evaluations()
    evaluations.want(_task(1))
    assert evaluations.ask(EvaluationRequest(evaluator="ghost")) is None
    assert (evaluations.unfinished, evaluations.waiting) == (0, 1)
    assert _ask(evaluations, "a") == 1


def test_nothing_is_unfinished_when_there_is_no_evaluator() -> None:
    """The end of a run waits for no one who is not there."""
    evaluations = Evaluations()
    evaluations.want(_task(1))
    assert evaluations.unfinished == 0
    assert _ask(evaluations, "a") == 1
    assert evaluations.unfinished == 1
    evaluations.gone("a")
    assert evaluations.unfinished == 0


def test_evaluators_that_are_too_slow_skip_the_oldest() -> None:
    evaluations = Evaluations()
    for number in range(1, MAX_WAITING + 3):
        evaluations.want(_task(number))
    assert _ask(evaluations, "a") == 3


@pytest.mark.parametrize(
    "modes", [("mean",), ("mean",) * 4, ("best-of-k",) * 4, ("mean", "mean", "best-of-k")]
)
def test_other_episodes_than_those_of_the_task_are_refused(modes: list[EvaluationMode]) -> None:
    evaluations = Evaluations()
    evaluations.want(_task(1, MODES))
    assert _ask(evaluations, "a") == 1
    with pytest.raises(MalformedMessageError, match="expected 2 episodes of each of"):
        evaluations.answer(_result("a", 1, modes))
    assert evaluations.unfinished == 1
    evaluations.answer(_result("a", 1, ["best-of-k", "mean", "mean", "best-of-k"]))
    assert _numbers(evaluations) == [1]
