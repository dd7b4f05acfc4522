"""One actor: join the run, then play and send until told to stop."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from time import monotonic

from a2s.actors.activity import Activity
from a2s.actors.environments.environment import Environment, require_alike
from a2s.actors.environments.making import seed_globals
from a2s.actors.metrics import Tally
from a2s.actors.outbox import Spool
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.actors.weights_client import Newest
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, RefusedError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import ActorStatus, Hello, Notice, Refusal, Welcome
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

_ASK_TIMEOUT_S = 5.0
_ASK_AGAIN_S = 0.2
_STATUS_EVERY_S = 1.0
_LOOK_EVERY_S = 0.1
_DRAIN_S = 5.0
_PATIENCE_S = 10.0
_QUOTAS_IN_SPOOL = 2


class Actor:
    """One actor of a run.

    Args:
        name: Unique among the actors of the run, and new for every process.
        worker: Its number on this machine.
        cause: Why the process before it in its place had to be replaced; empty if none had.
        bus: A connection to the learner.
        run: Name of the run.
        num_envs: Environments to step; ``None`` leaves it to the learner.
        spool_steps: Steps that may wait for an answer.
        tally: Where everything is counted.
        activity: Where calls into environments are noted.
        stopped: Set when the actor is to stop.
        on_environment: Told which environment is made, before it is.
        on_failure: Told what ends the actor, before environments are closed: that may hang.
        report: Called about once a second, on a thread of its own.
    """

    def __init__(
        self,
        *,
        name: str,
        worker: int,
        cause: str,
        bus: Bus,
        run: str,
        num_envs: int | None,
        spool_steps: int,
        tally: Tally,
        activity: Activity,
        stopped: threading.Event,
        on_environment: Callable[[EnvConfig], None],
        on_failure: Callable[[A2SError], None],
        report: Callable[[], None],
    ) -> None:
        self._name = name
        self._worker = worker
        self._cause = cause
        self._bus = bus
        self._keys = Keys(run)
        self._num_envs = num_envs
        self._tally = tally
        self._activity = activity
        self._stopped = stopped
        self._on_environment, self._on_failure = on_environment, on_failure
        self._report = report
        self._troubles = Troubles()
        self._newest = Newest(bus, self._keys)
        self._joining: Hello | None = None
        self._spool = Spool(
            bus, self._keys.segment, spool_steps, self._newest.hear, self._join_again, tally
        )
        self._welcome: Welcome | None = None
        self._notice: Notice | None = None
        self._rollout: Rollout | None = None
        self._ended = threading.Event()
        self._waiting_said_s = 0.0
        self._waiting_since_s: float | None = None

    def run(self) -> None:
        """Play until stopped.

        Raises:
            RefusedError: The learner refuses this actor.
            UsageError: The environment cannot be made here.
            FaultyEnvironmentError: The environment is broken.
        """
        self._bus.declare_presence(self._keys.live_actor(self._name))
        heartbeat = threading.Thread(target=self._beat, name="heartbeat")
        heartbeat.start()
        try:
            task = self._ask()
            if task is not None:
                self._welcome = task
                self._play(task)
        finally:
            left = self._spool.close(_DRAIN_S if self._stopped.is_set() else 0.0)
            self._ended.set()
            heartbeat.join()
            self._publish_status(leaving=True)
            if left:
                logger.warning("segments never answered actor=%s segments=%d", self._name, left)

    def _ask(self) -> Welcome | None:
        try:
            return self._hello(Hello(actor=self._name, num_envs=0, env_id="", spaces=None))
        except A2SError as error:
            self._on_failure(error)
            raise

    def _play(self, task: Welcome) -> None:
        config = task.env or EnvConfig(env_id=task.env_id)
        self._on_environment(config)
        # Before it has joined an actor has no place, and so is like all others.
        seed_globals(task.seed)
        with ExitStack() as stack:
            try:
                environments = [
                    stack.enter_context(closing(self._environment(config, index, task)))
                    for index in range(self._num_envs or task.num_envs)
                ]
                require_alike(environments)
                self._play_in(environments, task.env_id)
            except A2SError as error:
                self._on_failure(error)
                raise

    def _environment(self, config: EnvConfig, index: int, task: Welcome) -> Environment:
        return Environment(
            config,
            worker=self._worker,
            index=index,
            activity=self._activity,
            offset=task.spaces.obs_offset,
        )

    def _play_in(self, environments: list[Environment], env_id: str) -> None:
        num_envs = len(environments)
        hello = Hello(
            actor=self._name,
            num_envs=num_envs,
            env_id=env_id,
            spaces=environments[0].spaces,
            cause=self._cause,
            slot=self._worker,
        )
        welcome = self._join(hello)
        suggester: Suggester | None = None
        while welcome is not None:
            if self._rollout is None:
                self._rollout = Rollout(
                    self._name, environments, welcome.seed, self._tally, self._troubles
                )
            known = self._notice if welcome.clock == "lockstep" else None
            notice = self._newest.other_than(known, self._wait_for_weights)
            if notice is None:
                return
            if notice.generation != welcome.generation or self._is_of_another_run(notice):
                welcome = self._join(replace(hello, cause=""))
                continue
            if self._notice is None or notice.identity != self._notice.identity:
                suggester = self._pull() or suggester
                if welcome.clock == "async" and self._notice is not None:
                    # What waits long is of weights that are long gone.
                    self._spool.narrow(_QUOTAS_IN_SPOOL * self._notice.quota_steps * num_envs)
            if suggester is not None and self._notice is not None:
                self._send(suggester, self._notice, self._rollout)

    def _send(self, suggester: Suggester, notice: Notice, rollout: Rollout) -> None:
        def interrupted() -> bool:
            return self._stopped.is_set() or self._newest.overrules(notice)

        self._waiting_since_s = None
        dropped = self._troubles.dropped_steps
        for segment in rollout.play(suggester, notice, interrupted):
            if self._troubles.dropped_steps != dropped:  # known before the segment is learned from
                dropped = self._troubles.dropped_steps
                self._publish_status(leaving=False)
            answered = self._spool.answered
            while not self._spool.put(segment, timeout_s=_LOOK_EVERY_S) and self._proceed():
                if self._spool.answered > answered:  # the learner is there, and holds us back
                    answered, self._waiting_since_s = self._spool.answered, None
                self._say_waiting("room in the spool: the learner has answered no segment")
            self._waiting_since_s = None

    def _join(self, hello: Hello) -> Welcome | None:
        self._joining = hello
        welcome = self._hello(hello)
        if welcome is not None:
            self._welcome, self._notice = welcome, None
            self._joining = replace(hello, cause="")  # it has been told
            self._newest.forget()
            self._tally.count("joins")
            logger.info(
                "joined run=%s generation=%d slot=%d env=%s envs=%d",
                welcome.run, welcome.generation, welcome.slot, hello.env_id, hello.num_envs,
            )  # fmt: skip
        return welcome

    def _is_of_another_run(self, notice: Notice) -> bool:
        """Whether versions have begun anew: a learner was started without the past of the last."""
        return self._notice is not None and notice.version < self._notice.version

    def _join_again(self) -> None:
        """Say hello as when joining: the learner took this actor off its roster.

        Once, on the sender's thread; when it does not help the segment is unknown again.
        """
        if self._joining is not None:
            self._bus.ask(self._keys.hello, encode(self._joining), _ASK_TIMEOUT_S)

    def _hello(self, hello: Hello) -> Welcome | None:
        payload = encode(hello)
        while self._proceed():
            reply = self._bus.ask(self._keys.hello, payload, _ASK_TIMEOUT_S)
            if reply is None:
                self._say_waiting(f"the learner of run {self._keys.run!r} to answer a hello")
                self._stopped.wait(_ASK_AGAIN_S)
                continue
            answer = decode(reply, Welcome, Refusal)
            if isinstance(answer, Refusal):
                raise RefusedError(f"the learner refused this actor: {answer.reason}")
            assert isinstance(answer, Welcome)
            self._waiting_since_s = None
            return answer
        return None

    def _pull(self) -> Suggester | None:
        weights = self._newest.pull()
        if weights is None:
            self._stopped.wait(_ASK_AGAIN_S)
            return None
        before, self._notice = self._notice, weights.notice
        if before is not None and weights.notice.epoch > before.epoch:
            self._tally.count("recovery_events", weights.notice.epoch - before.epoch)
        self._tally.gauge("weights_version", weights.notice.version)
        self._tally.gauge("epoch", weights.notice.epoch)
        self._tally.gauge("weights_received_timestamp_seconds", time.time())
        self._tally.count("weights_received_bytes", len(weights.graph))
        return Suggester(weights.graph)

    def _wait_for_weights(self) -> bool:
        self._say_waiting("new weights from the learner")
        return self._proceed()

    def _proceed(self) -> bool:
        return not self._stopped.is_set()

    def _beat(self) -> None:
        """Tell how it goes once a second, also while an environment keeps the actor waiting."""
        while not self._ended.wait(_STATUS_EVERY_S):
            self._report()
            self._publish_status(leaving=False)

    def _publish_status(self, *, leaving: bool) -> None:
        if self._welcome is None:
            return
        doing = self._activity.now()
        status = ActorStatus(
            actor=self._name,
            slot=self._welcome.slot,
            weights_version=self._notice.version if self._notice else 0,
            epoch=self._notice.epoch if self._notice else 0,
            env_steps=int(self._tally.total("env_steps")),
            episodes=int(self._tally.total("episodes")),
            segments_sent=self._rollout.segments_made if self._rollout else 0,
            segments_answered=self._spool.answered,
            spooled_steps=self._spool.steps,
            leaving=leaving,
            doing="" if doing is None else str(doing),
            dropped_steps=self._troubles.dropped_steps,
            trouble=self._troubles.latest,
        )
        self._bus.publish(self._keys.actor_status(self._name), encode(status))

    def _say_waiting(self, what: str) -> None:
        now_s = monotonic()
        if self._waiting_since_s is None:
            self._waiting_since_s = self._waiting_said_s = now_s
        elif now_s - self._waiting_said_s >= _PATIENCE_S:
            self._waiting_said_s = now_s
            logger.warning(
                "waiting for %s for %.0f s; is `a2s learner` running?",
                what, now_s - self._waiting_since_s,
            )  # fmt: skip
