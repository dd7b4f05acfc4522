"""The evaluations that a learner wants: who plays them, and what came of them."""

import threading
from collections import deque
from typing import NamedTuple

from a2s.learner.ingest.members import MAX_SEEN
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import EvaluationRequest, EvaluationResult, EvaluationTask

MAX_WAITING = 8


class Evaluated(NamedTuple):
    """A task and what came of it."""

    task: EvaluationTask
    result: EvaluationResult


class Evaluations:
    """Tasks until an evaluator has them, and results until the learner's loop takes them.

    The loop and the handlers of the bus may call it at once. An evaluator that leaves without a
    result gives its task back. At most `MAX_WAITING` wait: evaluators that are slower than the
    learner skip the oldest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[EvaluationTask] = deque(maxlen=MAX_WAITING)
        self._seen: set[str] = set()  # by their tokens, which those have who may be missed
        self._present: dict[str, EvaluationTask | None] = {}  # of those, who has asked
        self._done: list[Evaluated] = []

    @property
    def unfinished(self) -> int:
        """Tasks that evaluators who are there have not answered yet."""
        with self._changed:
            taken = sum(task is not None for task in self._present.values())
            return taken + len(self._waiting) if self._present else 0

    @property
    def waiting(self) -> int:
        """Tasks that nobody has taken yet."""
        with self._changed:
            return len(self._waiting)

    def want(self, task: EvaluationTask) -> None:
        """Have weights evaluated."""
        with self._changed:
            self._waiting.append(task)

    def ask(self, request: EvaluationRequest) -> EvaluationTask | None:
        """Give an evaluator a task, the same one again until it is answered; ``None``: no work.

        Nor is there work for one that has no token: nobody would see it leave.
        """
        with self._changed:
            if request.evaluator not in self._seen:
                return None
            task = self._present.get(request.evaluator)
            if task is None and self._waiting:
                task = self._waiting.popleft()
            self._present[request.evaluator] = task
            return task

    def answer(self, result: EvaluationResult) -> None:
        """Take what came of a task; what was answered before, or is nobody's task, is ignored.

        Raises:
            MalformedMessageError: These are not the episodes of the task.
        """
        with self._changed:
            task = self._present.get(result.evaluator)
            asked = None if task is None else (task.generation, task.number)
            if task is None or asked != (result.generation, result.number):
                return
            found = [episode.mode for episode in result.episodes]
            if sorted(found) != sorted(task.modes * task.episodes):
                expected = f"{task.episodes} episodes of each of {task.modes}"
                raise MalformedMessageError(f"evaluation: found {found}, expected {expected}")
            self._present[result.evaluator] = None
            self._done.append(Evaluated(task, result))
            self._changed.notify_all()

    def here(self, name: str) -> None:
        """An evaluator, or somebody else, can be seen."""
        with self._changed:
            if len(self._seen) < MAX_SEEN:
                self._seen.add(name)

    def gone(self, evaluator: str) -> None:
        """An evaluator has left, or somebody else."""
        with self._changed:
            self._seen.discard(evaluator)
            task = self._present.pop(evaluator, None)
            if task is not None and len(self._waiting) < MAX_WAITING:
                self._waiting.appendleft(task)

    def take(self, timeout_s: float = 0.0) -> list[Evaluated]:
        """Take the results since the last call, or wait for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._done, timeout_s)
            done, self._done = self._done, []
            return done
