"""Actors that play from a script, in the process of the learner, which may be killed at any send.

A learner publishes, its actors send, and only then does the learner go on: nothing depends on time.
What a kill leaves is a copy of the files at that moment.
"""

import io
import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from learners import SPACES, learner_of

from a2s.learner.ingest.members import Member
from a2s.learner.run.progress import PlainView
from a2s.learner.run.status import Status
from a2s.protocol.codec import decode, encode
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Hello, Notice, RunStatus, Segment, Welcome

ENVS, PIECES = 2, 2

SMALL = {"policy_sizes": (8,), "value_sizes": (8,), "q_sizes": (8,)}
ON_POLICY = {
    **SMALL, "batch_steps": 64, "first_batch_steps": 32, "window_steps": 256, "q_steps": 4,
    "policy_epochs": 2, "critic_epochs": 2,
}  # fmt: skip
OFF_POLICY = {
    "warm_up_steps": 16, "batch_rows": 8, "send_every_steps": 4, "replay_rows": 1000,
    "policy_sizes": (16,), "critic_sizes": (16,), "num_quantiles": 3, "quantiles_to_drop": 1,
    "average_updates": 10,
}  # fmt: skip
WAYS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "lockstep": ({"total_steps": 1200, "checkpoint_every_updates": 5}, ON_POLICY),
    "lag of 1": (
        {"total_steps": 1200, "checkpoint_every_updates": 5},
        {**ON_POLICY, "act_while_learning": True},
    ),
    "async": ({"total_steps": 1200, "checkpoint_every_updates": 5, "clock": "async"}, ON_POLICY),
    "off-policy": (
        {"variant": "off-policy", "total_steps": 300, "checkpoint_every_updates": 30},
        OFF_POLICY,
    ),
    "off-policy lockstep": (
        {
            "variant": "off-policy", "total_steps": 300, "checkpoint_every_updates": 30,
            "clock": "lockstep",
        },
        OFF_POLICY,
    ),
}  # fmt: skip


class Killed(BaseException):
    """The learner is gone; nothing catches this."""


class ScriptedActor:
    """Sends, for every version, the same segments: of two environments, two pieces each.

    It outlives learners: what one has accepted is not sent to the next. ``before_send`` is called
    with the number of segments that were sent.
    """

    def __init__(self, slot: int, before_send: Callable[[], None]) -> None:
        self._slot, self._before_send = slot, before_send
        self._done = set[tuple[int, int, int]]()
        self._seq, self._generation = 0, 0

    def connect(self, exchange: Exchange) -> None:
        """Find a learner there, as soon as there is one."""
        self._bus, self._keys = InProcessBus(exchange), Keys("default")
        self._bus.subscribe(self._keys.notice, lambda payload: self._play(decode(payload, Notice)))
        self._bus.declare_presence(self._keys.live_actor(f"actor-{self._slot}"))
        self._bus.watch_presence(self._keys.live_learner, lambda _, here: self._join(here))

    def _join(self, here: bool) -> None:
        if here:
            hello = Hello(
                actor=f"actor-{self._slot}", num_envs=ENVS, env_id="Test-v0", spaces=SPACES,
                slot=self._slot,
            )  # fmt: skip
            answer = self._bus.ask(self._keys.hello, encode(hello), 1.0)
            assert answer is not None
            self._generation = decode(answer, Welcome).generation

    def _play(self, notice: Notice) -> None:
        for env in range(ENVS):
            for piece in range(PIECES):
                part = (notice.version, env, piece)
                if part not in self._done:
                    self._before_send()
                    self._send(self._segment(notice, env, piece))
                    self._seq += 1
                    self._done.add(part)

    def _segment(self, notice: Notice, env: int, piece: int) -> Segment:
        steps = -(-notice.quota_steps // PIECES)
        rng = np.random.default_rng([self._slot, notice.version, env, piece])
        suggestion = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
        return Segment(
            actor=f"actor-{self._slot}", seq=self._seq, generation=self._generation,
            epoch=notice.epoch, weights_version=notice.version, env=env, suggestion=suggestion,
            obs=rng.standard_normal((steps, 2)).astype(np.float32),
            log_prob=np.full(steps, -1.0, np.float32), reward=1 - abs(suggestion[:, 0] - 0.6),
            final_obs=rng.standard_normal(2).astype(np.float32), terminated=piece == 1,
            truncated=False, episode_return=float(rng.uniform(0, 9)), episode_length=2 * steps,
        )  # fmt: skip

    def _send(self, segment: Segment) -> None:
        answer = self._bus.ask(self._keys.segment, encode(segment), 1.0)
        assert answer is not None
        ack = decode(answer, Ack)
        assert ack.verdict in ("accepted", "duplicate"), ack


class _Asking(PlainView):
    """Whenever something could be shown, asks over the bus what the learner waits for."""

    def __init__(self, exchange: Exchange, told: set[str]) -> None:
        super().__init__(io.StringIO())
        self._bus, self._told = InProcessBus(exchange), told

    def show(self, status: Status, members: Sequence[Member], kl: float | None) -> None:
        answer = self._bus.ask(Keys("default").status, b"", 1.0)
        assert answer is not None
        told = decode(answer, RunStatus)
        assert isinstance(told, RunStatus)
        self._told.add(told.waiting_for)


class Script:
    """A run of two scripted actors; ``settings`` are of the run and of the algorithm.

    ``kill_at`` are numbers of segments before which the learner is killed; then ``on_kill`` may
    change what is left. The marks of its learners are ``mark`` and those after it. ``told`` is all
    that those said they wait for.
    """

    def __init__(
        self,
        path: Path,
        options: Mapping[str, Any],
        settings: Mapping[str, Any],
        *,
        kill_at: tuple[int, ...] = (),
        on_kill: Callable[[Path], None] = lambda _: None,
        actors: int = 2,
        mark: int = 0,
    ) -> None:
        self._path, self._options, self._settings = path, options, settings
        self._kill_at, self._sent, self._left = kill_at, 0, path.with_name("left")
        self._on_kill, self._marks = on_kill, itertools.count(mark)
        self.told: set[str] = set()
        self._actors = [ScriptedActor(slot, self._before_send) for slot in range(actors)]

    def run(self) -> dict[str, Any]:
        """Learn to the end, however often that is interrupted; the last learner's summary."""
        resume = False
        self._path.mkdir()
        while True:
            try:
                return self._learn(resume)
            except Killed:
                shutil.rmtree(self._path)
                self._left.rename(self._path)
                self._on_kill(self._path)
                resume = True

    def _before_send(self) -> None:
        self._sent += 1
        if self._sent in self._kill_at:
            shutil.copytree(self._path, self._left)
            raise Killed

    def _learn(self, resume: bool) -> dict[str, Any]:
        exchange = Exchange()
        for actor in self._actors:
            actor.connect(exchange)
        options = {"env": "Test-v0", "n": len(self._actors), "envs": ENVS, **self._options}
        learner = learner_of(
            options, self._settings, InProcessBus(exchange), self._path,
            view=_Asking(exchange, self.told), resume=resume, mark=next(self._marks),
        )  # fmt: skip
        return learner.run(lambda: False)
