"""An evaluator: plays whole episodes with the weights that a learner wants to be evaluated."""

import logging
import threading
import uuid
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import NamedTuple

from a2s.actors.environments.allowed import require_allowed
from a2s.actors.environments.environment import Environment
from a2s.actors.evaluation import Evaluation, make_environments, play, trained_on
from a2s.actors.metrics import ActorMetrics
from a2s.actors.parent import Parent
from a2s.actors.patience import Patience
from a2s.actors.suggester import Suggester
from a2s.actors.task import Task
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, RefusedError, UsageError
from a2s.protocol.evaluation_messages import (
    EvaluatedEpisode,
    EvaluationMode,
    EvaluationRequest,
    EvaluationResult,
    EvaluationTask,
)
from a2s.protocol.keys import Keys
from a2s.protocol.messages import EpisodeMetric, Refusal
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

_ASK_TIMEOUT_S = 5.0
_ASK_EVERY_S = 0.5
_REPORT_EVERY_S = 1.0
_ENVS = 8


class _Reply(NamedTuple):
    """What the learner said: whether anything, and whether it was a task."""

    was_heard: bool
    task: EvaluationTask | None = None


class Evaluator:
    """An evaluator of a run; it is no member of it, and nothing waits for it but its last result.

    ``on_failure`` is called with the error that ends it before environments are closed. ``env_id``
    is empty until a task has told it.
    """

    def __init__(
        self,
        task: Task,
        bus: Bus,
        metrics: ActorMetrics,
        parent: Parent,
        on_failure: Callable[[A2SError], None],
    ) -> None:
        self.env_id = ""
        self._name = f"{task.label}-{uuid.uuid4().hex[:8]}"
        self._num_envs, self._bus, self._keys = task.num_envs or _ENVS, bus, Keys(task.run)
        self._metrics, self._parent, self._on_failure = metrics, parent, on_failure
        self._patience = Patience(bus, self._keys, speaks=task.worker == 0, known_as=task.known_as)
        self._made_for: tuple[EnvConfig, str | None] | None = None  # with the offset of weights
        self._allowed = task.allow_env
        self._environments: list[Environment] = []
        self._ended = threading.Event()

    def run(self) -> None:
        """Evaluate until stopped.

        Raises:
            RefusedError: The learner cannot use what this evaluator says.
            UsageError: The environment cannot be made here, or does not fit the policy.
            FaultyEnvironmentError: The environment is broken.
        """
        self._bus.declare_presence(self._keys.live_actor(self._name))
        heartbeat = threading.Thread(target=self._beat, name="heartbeat")
        heartbeat.start()
        try:
            with ExitStack() as stack:
                try:
                    while self._proceed():
                        task = self._ask()
                        if task is None:
                            self._parent.stopped.wait(_ASK_EVERY_S)
                        else:
                            self._evaluate(task, stack)
                except A2SError as error:
                    self._on_failure(error)
                    raise
        finally:
            self._ended.set()
            heartbeat.join()

    def _ask(self) -> EvaluationTask | None:
        payload = encode(EvaluationRequest(evaluator=self._name))
        return self._ask_learner(self._keys.evaluation_task, payload).task

    def _evaluate(self, task: EvaluationTask, stack: ExitStack) -> None:
        episodes: list[EvaluatedEpisode] = []
        found: dict[EvaluationMode, Evaluation] = {}
        for mode in task.modes:
            suggester = Suggester(task.graph, mode)
            environments = self._environments_of(suggester.metadata, task.episodes, stack)
            played = play(suggester, environments, task.episodes, task.seed, self._proceed)
            if played is None:
                return
            found[mode] = played
            episodes += [
                EvaluatedEpisode(mode=mode, episode_return=episode_return, length=length)
                for episode_return, length in zip(played.returns, played.lengths, strict=True)
            ]
        metrics = found["mean"].metrics if "mean" in found else {}
        result = EvaluationResult(
            evaluator=self._name,
            generation=task.generation,
            number=task.number,
            episodes=tuple(episodes),
            metrics=tuple(EpisodeMetric(name=n, value=v) for n, v in metrics.items()),
        )
        payload = encode(result)
        while self._proceed():
            if self._ask_learner(self._keys.evaluation_result, payload).was_heard:
                self._metrics.evaluations.inc()
                return
            self._parent.stopped.wait(_ASK_EVERY_S)

    def _ask_learner(self, key: str, payload: bytes) -> _Reply:
        """Ask, and take a refusal for the end.

        Raises:
            RefusedError: It is one.
        """
        reply = self._bus.ask(key, payload, _ASK_TIMEOUT_S)
        if reply is None:
            self._patience.wait_for(f"the learner of run {self._keys.run!r} to answer")
            return _Reply(was_heard=False)
        self._patience.over()
        if not reply:
            return _Reply(was_heard=True)
        answer = decode(reply, EvaluationTask, Refusal)
        if isinstance(answer, Refusal):
            raise RefusedError(f"the learner refused this evaluator: {answer.reason}")
        assert isinstance(answer, EvaluationTask)
        return _Reply(was_heard=True, task=answer)

    def _environments_of(
        self, metadata: dict[str, str], episodes: int, stack: ExitStack
    ) -> list[Environment]:
        """Give the environments that the weights were made for, made when they are first needed."""
        config = trained_on("the learner's policy", metadata)
        if config is None:
            raise UsageError("the learner's policy: its metadata name no environment")
        made_for = config, metadata.get("obs_offset")
        if made_for != self._made_for:
            require_allowed(config, self._allowed)
            self.env_id, self._made_for = config.env_id, made_for
            self._parent.report({"env_id": config.env_id, "timeout_s": config.timeout_s})
            count = min(self._num_envs, episodes)
            self._environments = make_environments(config, metadata, count, self._parent.activity)
            for environment in self._environments:
                stack.enter_context(closing(environment))
            logger.info("evaluates run=%s env=%s envs=%d", self._keys.run, config.env_id, count)
        return self._environments

    def _beat(self) -> None:
        while not self._ended.wait(_REPORT_EVERY_S):
            self._parent.report(self._metrics.report())

    def _proceed(self) -> bool:
        return not self._parent.stopped.is_set()
