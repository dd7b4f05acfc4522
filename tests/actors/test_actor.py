"""An actor of a learner that takes its time."""

import hashlib
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from a2s.actors import actor as actor_module
from a2s.actors.activity import Activity
from a2s.actors.actor import Actor
from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.task import Task
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, FaultyEnvironmentError
from a2s.protocol.fields import Spaces
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, ActorStatus, Hello, Notice, Segment, Weights, Welcome

KEYS = Keys("r")
SPACES = Spaces(
    obs_size=2,
    action_low=np.array([-1.0, 0.5], np.float32),
    action_high=np.array([3.0, 0.75], np.float32),
)
QUOTA_STEPS = 3
TASK = Task(
    label="a-0", worker=0, connect="", run="r", num_envs=1, outbox_steps=100,
    allow_env=("a2s_test_envs",),
)  # fmt: skip


class _Looked(threading.Event):
    """Counts how often somebody looks whether it is set."""

    def __init__(self) -> None:
        super().__init__()
        self.looks = 0

    def is_set(self) -> bool:
        self.looks += 1
        return super().is_set()


class _Learner:
    """Recovers when it has the first segment, and then holds the weights of that back."""

    def __init__(self, exchange: Exchange, graph: bytes) -> None:
        self._bus, self._graph = InProcessBus(exchange), graph
        self._newest = self._notice(0)
        self.is_asked, self.is_ready = threading.Event(), threading.Event()
        self.epochs: list[int] = []  # of segments
        self.reports = 0  # since the weights were asked for
        self._bus.answer(KEYS.hello, self._welcome)
        self._bus.answer(KEYS.notice, lambda _: encode(self._newest))
        self._bus.answer(KEYS.weights, self._give)
        self._bus.answer(KEYS.segment, self._take)
        self._bus.subscribe_each(KEYS.actor_status(), self._hear)

    def _notice(self, epoch: int) -> Notice:
        return Notice(
            generation=1, epoch=epoch, version=1 + epoch, quota_steps=QUOTA_STEPS,
            quota_episodes=0, num_bytes=len(self._graph),
            sha256=hashlib.sha256(self._graph).hexdigest(),
        )  # fmt: skip

    def _welcome(self, payload: bytes) -> bytes:
        slot = -1 if decode(payload, Hello).spaces is None else 0
        return encode(
            Welcome(
                run="r", generation=1, env_id="a2s_test_envs:Count-v0", spaces=SPACES, num_envs=1,
                clock="async", slot=slot, seed=1, window=16,
            )
        )  # fmt: skip

    def _give(self, _: bytes) -> bytes:
        if self._newest.epoch:
            self.is_asked.set()
            self.is_ready.wait()
        return encode(Weights(notice=self._newest, graph=self._graph))

    def _take(self, payload: bytes) -> bytes:
        self.epochs.append(decode(payload, Segment).epoch)
        if self._newest.epoch == 0:
            self._newest = self._notice(1)
            self._bus.publish(KEYS.notice, encode(self._newest))
        return encode(
            Ack(
                verdict="accepted", reason="", generation=1, epoch=self._newest.epoch,
                weights_version=self._newest.version, wait_s=0.0,
            )
        )  # fmt: skip

    def _hear(self, _: str, payload: bytes) -> None:
        decode(payload, ActorStatus)
        self.reports += self.is_asked.is_set()


def test_after_a_recovery_an_async_actor_waits_for_weights_and_is_not_busy_with_it(
    make_graph: Callable[..., bytes], wait_for: Callable[..., None]
) -> None:
    """Without weights to play by, it would look for them as often as the machine can."""
    exchange, stopped = Exchange(), _Looked()
    learner = _Learner(exchange, make_graph())
    with _acting(exchange, learner, stopped, lambda _: None):
        wait_for(learner.is_asked.is_set, "a request for the weights of the recovery")
        wait_for(lambda: learner.reports > 0, "a report")
        looks = stopped.looks
        wait_for(lambda: learner.reports > 1, "the next report, a second later")
        assert stopped.looks - looks < 1000
        learner.is_ready.set()
        wait_for(lambda: 1 in learner.epochs, "a segment by the new weights")
    assert learner.epochs == sorted(learner.epochs)


def test_the_first_accepted_segment_is_reported_at_once(
    make_graph: Callable[..., bytes],
    wait_for: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that is killed within the second in which it would report has worked all the same."""
    monkeypatch.setattr(actor_module, "_STATUS_EVERY_S", 1000.0)
    exchange, reports = Exchange(), list[dict[str, Any]]()
    with _acting(exchange, _Learner(exchange, make_graph()), threading.Event(), reports.append):
        wait_for(lambda: {"accepted": 1.0} in reports, "a report of work")


class _Another(_Learner):
    """Another run takes its place at the first segment, with its environment made otherwise."""

    generation = 1
    made: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, exchange: Exchange, graph: bytes, then: Mapping[str, Any]) -> None:
        self._then, self.stopped = then, threading.Event()
        super().__init__(exchange, graph)

    def _notice(self, epoch: int) -> Notice:
        return replace(super()._notice(epoch), generation=self.generation)

    def _welcome(self, payload: bytes) -> bytes:
        welcome = decode(super()._welcome(payload), Welcome)
        offset = self.made.get("offset")
        return encode(
            replace(
                welcome,
                generation=self.generation,
                env=EnvConfig(env_id=welcome.env_id, **self.made.get("env", {})),
                spaces=replace(SPACES, obs_offset=offset),
            )
        )

    def _take(self, payload: bytes) -> bytes:
        if decode(payload, Segment).generation == 2:  # it plays on
            self.stopped.set()
        self.generation, self.made = 2, self._then
        self._newest = self._notice(0)
        self._bus.publish(KEYS.notice, encode(self._newest))
        return encode(
            Ack(verdict="stale", reason="", generation=2, epoch=0, weights_version=1, wait_s=0.0)
        )


@pytest.mark.parametrize(
    "then", [{"env": {"action_repeat": 2}}, {"offset": np.ones(2, np.float32)}], ids=str
)
def test_who_is_to_make_another_environment_begins_anew(
    make_graph: Callable[..., bytes], then: Mapping[str, Any]
) -> None:
    """Nobody would see that it plays the one of the run before."""
    exchange = Exchange()
    stopped = _Another(exchange, make_graph(), then).stopped
    parent: Any = SimpleNamespace(stopped=stopped, activity=Activity(), report=lambda _: None)
    actor = Actor(TASK, InProcessBus(exchange), ActorMetrics(), parent, lambda _: None)
    with pytest.raises(A2SError, match="Count-v0: found another way to make it or another offset"):
        actor.run()


class _AnswersLate(_Learner):
    """Answers no segment before the environment, which fails in its third step, has failed."""

    def __init__(self, exchange: Exchange, graph: bytes) -> None:
        self.has_failed = threading.Event()
        super().__init__(exchange, graph)

    def _notice(self, epoch: int) -> Notice:
        return replace(super()._notice(epoch), quota_steps=2)

    def _welcome(self, payload: bytes) -> bytes:
        welcome = decode(super()._welcome(payload), Welcome)
        return encode(replace(welcome, env_id="a2s_test_envs:Crash-v0"))

    def _take(self, payload: bytes) -> bytes:
        self.has_failed.wait()
        return super()._take(payload)


def test_what_was_played_before_a_failure_is_sent_until_it_is_answered(
    make_graph: Callable[..., bytes],
) -> None:
    """Otherwise it would be chance whether a process that failed has worked."""
    exchange, metrics = Exchange(), ActorMetrics()
    learner = _AnswersLate(exchange, make_graph())
    parent: Any = SimpleNamespace(
        stopped=threading.Event(), activity=Activity(), report=lambda _: None
    )
    actor = Actor(TASK, InProcessBus(exchange), metrics, parent, lambda _: learner.has_failed.set())
    with pytest.raises(FaultyEnvironmentError, match="the simulator is broken"):
        actor.run()
    assert total(metrics.acks.labels("accepted")) == 1


@contextmanager
def _acting(
    exchange: Exchange,
    learner: _Learner,
    stopped: threading.Event,
    report: Callable[[dict[str, Any]], None],
) -> Iterator[None]:
    """An actor at work; its parent's process would be this one."""
    parent: Any = SimpleNamespace(stopped=stopped, activity=Activity(), report=report)
    actor = Actor(TASK, InProcessBus(exchange), ActorMetrics(), parent, lambda _: None)
    thread = threading.Thread(target=actor.run)
    thread.start()
    try:
        yield
    finally:
        learner.is_ready.set()
        stopped.set()
        thread.join()
