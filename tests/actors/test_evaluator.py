"""An evaluator whose learner gives place to another."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from a2s.actors.activity import Activity
from a2s.actors.evaluation import make_environments, play
from a2s.actors.evaluator import Evaluator
from a2s.actors.metrics import ActorMetrics
from a2s.actors.suggester import Suggester
from a2s.actors.task import Task
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.evaluation_messages import EvaluationResult, EvaluationTask
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys

ENV = "a2s_test_envs:Reach-v0"
TASK = Task(
    label="e-0", worker=0, connect="", run="r", num_envs=1, outbox_steps=1, evaluates=True,
    allow_env=("a2s_test_envs",),
)  # fmt: skip
SIZES: dict[str, Any] = {"obs_size": 1, "low": (-1.0,), "high": (1.0,)}


def test_each_task_is_played_less_the_offset_of_its_weights(
    make_graph: Callable[..., bytes],
) -> None:
    """That of the run before would be seen by nobody."""
    graphs = [
        make_graph(metadata={"env": ENV, **offset}, **SIZES)
        for offset in ({}, {"obs_offset": "[1.0]"})
    ]
    bus, keys, stopped = InProcessBus(Exchange()), Keys("r"), threading.Event()
    found: list[float] = []

    def give(_: bytes) -> bytes:
        task = EvaluationTask(
            generation=1 + len(found), number=1, env_steps=0, weights_version=1, modes=("mean",),
            episodes=1, seed=3, graph=graphs[len(found)],
        )  # fmt: skip
        return encode(task)

    def take(payload: bytes) -> bytes:
        found.append(decode(payload, EvaluationResult).episodes[0].episode_return)
        if len(found) == len(graphs):
            stopped.set()
        return b""

    bus.answer(keys.evaluation_task, give)
    bus.answer(keys.evaluation_result, take)
    parent: Any = SimpleNamespace(stopped=stopped, activity=Activity(), report=lambda _: None)
    Evaluator(TASK, bus, ActorMetrics(), parent, lambda _: None).run()

    def alone(graph: bytes) -> float:
        suggester = Suggester(graph, "mean")
        config = EnvConfig(env_id=ENV)
        environments = make_environments(config, suggester.metadata, 1, Activity())
        played = play(suggester, environments, 1, 3)
        assert played is not None
        return played.mean

    assert found == [pytest.approx(alone(graph)) for graph in graphs]
    assert found[0] != pytest.approx(found[1])
