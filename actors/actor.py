"""One actor: join the run, then play and send until told to stop."""

import logging
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace

from a2s.actors.environments.allowed import require_allowed
from a2s.actors.environments.environment import Environment, require_alike
from a2s.actors.environments.making import seed_globals
from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.outbox import Outbox
from a2s.actors.parent import Parent
from a2s.actors.patience import Patience
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.task import Task
from a2s.actors.troubles import Troubles
from a2s.actors.weights_client import WeightsClient
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, RefusedError
from a2s.protocol.generations import start_of
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, ActorStatus, Hello, Notice, Refusal, Segment, Welcome
from a2s.protocol.transport import Bus

logger = logging.getLogger(__name__)

_ASK_TIMEOUT_S = 5.0
_ASK_AGAIN_S = 0.2
_STATUS_EVERY_S = 1.0
_LOOK_EVERY_S = 0.1
_DRAIN_S = 5.0
_QUOTAS_IN_OUTBOX = 2
_BESIDE_S = 0.02  # longer than weights need on a short way


class Actor:
    """One actor of a run; its name is new for every process.

    ``on_failure`` is called with the error that ends the actor before environments are closed,
    because closing may hang. ``env_id`` is empty until the learner has told it.
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
        self._task = task
        self._bus = bus
        self._keys = keys = Keys(task.run)
        # Who is known may ask as itself alone; others need not be heard by its name.
        self._hello_key = keys.hello_of(self._name) if task.known_as else keys.hello
        segment_key = keys.segment_of(self._name) if task.known_as else keys.segment
        self._metrics = metrics
        self._parent, self._stopped, self._on_failure = parent, parent.stopped, on_failure
        self._troubles = Troubles()
        self._weights = WeightsClient(bus, keys)
        self._joining: Hello | None = None
        self._has_worked = False
        self._outbox = Outbox(
            bus, segment_key, task.outbox_steps, self._hear, self._join_again,
            metrics,
        )  # fmt: skip
        self._welcome: Welcome | None = None
        self._notice: Notice | None = None
        self._rollout: Rollout | None = None
        self._ended = threading.Event()
        self._patience = Patience(bus, keys, speaks=task.worker == 0, known_as=task.known_as)

    def run(self) -> None:
        """Play until stopped.

        Raises:
            RefusedError: The learner refuses this actor.
            UsageError: The environment cannot be made here.
            FaultyEnvironmentError: The environment is broken.
            A2SError: The learner wants it made otherwise than it is here.
        """
        self._bus.declare_presence(self._keys.live_actor(self._name))
        heartbeat = threading.Thread(target=self._beat, name="heartbeat")
        heartbeat.start()
        try:
            nothing = Hello(actor=self._name, num_envs=0, env_id="", spaces=None)
            self._welcome = self._hello(nothing)  # which environment, and how many
            if self._welcome is not None:
                self._play(self._welcome)
        finally:
            left = self._outbox.close(_DRAIN_S)
            self._ended.set()
            heartbeat.join()
            self._publish_status(leaving=True)
            if left:
                logger.warning("segments never answered actor=%s segments=%d", self._name, left)

    def _play(self, told: Welcome) -> None:
        """Make the environments, play in them, and close them."""
        config = told.env or EnvConfig(env_id=told.env_id)
        self.env_id = config.env_id
        self._parent.report({"env_id": config.env_id, "timeout_s": config.timeout_s})
        # Before it has joined an actor has no place, so all actors use the same seed.
        seed_globals(told.seed)
        with ExitStack() as stack:
            try:
                require_allowed(config, self._task.allow_env)
                environments = []
                for index in range(self._task.num_envs or told.num_envs):
                    environment = Environment(
                        config,
                        worker=self._task.worker,
                        index=index,
                        activity=self._parent.activity,
                        offset=told.spaces.obs_offset,
                        fast=self._task.fast_envs,
                    )
                    environments.append(stack.enter_context(closing(environment)))
                require_alike(environments)
                self._play_in(environments, told)
            except A2SError as error:
                if self._rollout is None:  # else its replacement says why
                    self._troubles.latest = str(error)
                self._on_failure(error)
                raise

    def _play_in(self, environments: list[Environment], told: Welcome) -> None:
        hello = Hello(
            actor=self._name,
            num_envs=len(environments),
            env_id=told.env_id,
            spaces=environments[0].spaces,
            cause=self._task.cause,
            slot=self._task.worker,
        )
        welcome = self._join(hello)
        suggester: Suggester | None = None
        while welcome is not None:
            _require_made_for(told, welcome)
            if self._rollout is None:
                self._rollout = Rollout(
                    self._name, environments, welcome.seed, self._metrics, self._troubles
                )
            self._rollout.short_steps = welcome.short_steps
            known = self._notice if welcome.clock == "lockstep" else None
            with self._metrics.spending("waiting"):
                notice = self._weights.other_than(known, self._wait_for_weights)
            if notice is None:
                return
            # Versions that begin anew come from a learner without the earlier learner's past.
            begins_anew = self._notice is not None and notice.version < self._notice.version
            if notice.generation != welcome.generation or begins_anew:
                welcome = self._join(replace(hello, cause=""))
                continue
            if self._notice is None or notice.identity != self._notice.identity:
                beside = welcome.clock == "async" and self._may_play_on()
                with self._metrics.spending("waiting"):
                    suggester = self._pull(beside=beside) or suggester
                if welcome.clock == "async" and self._notice is not None:
                    # A segment that waits long was made with outdated weights.
                    quota_steps = self._notice.quota_steps * len(environments)
                    self._outbox.narrow(_QUOTAS_IN_OUTBOX * quota_steps)
            is_new = self._notice is not known  # otherwise its quota has been played
            if suggester is not None and self._notice is not None and is_new:
                self._send(suggester, self._notice, self._rollout)

    def _send(self, suggester: Suggester, notice: Notice, rollout: Rollout) -> None:
        def interrupted() -> bool:
            return self._stopped.is_set() or self._weights.overrules(notice)

        self._patience.over()
        dropped = self._troubles.dropped_steps
        for segment in rollout.play(suggester, notice, interrupted):
            if self._troubles.dropped_steps != dropped:  # known before the segment is learned from
                dropped = self._troubles.dropped_steps
                self._publish_status(leaving=False)
            with self._metrics.spending("sending"):
                self._put(segment)

    def _put(self, segment: Segment) -> None:
        answered = self._outbox.answered
        while not self._outbox.put(segment, timeout_s=_LOOK_EVERY_S) and self._proceed():
            if self._outbox.answered > answered:  # the learner is there, and holds us back
                answered = self._outbox.answered
                self._patience.over()
            self._patience.wait_for("room in the outbox: the learner has answered no segment")
        self._patience.over()

    def _join(self, hello: Hello) -> Welcome | None:
        self._joining = hello
        welcome = self._hello(hello)
        if welcome is not None:
            self._welcome, self._notice = welcome, None
            self._outbox.window = welcome.window
            self._joining = replace(hello, cause="")  # it has been told
            self._weights.forget()
            self._metrics.joins.inc()
            logger.info(
                "joined run=%s generation=%d slot=%d env=%s envs=%d",
                welcome.run, start_of(welcome.generation), welcome.slot, hello.env_id,
                hello.num_envs,
            )  # fmt: skip
        return welcome

    def _join_again(self) -> None:
        """Say hello as when joining, once: the learner does not count this actor as a member.

        On the outbox's thread; when it does not help, the segment is unknown again.
        """
        if self._joining is not None:
            self._ask(self._joining)

    def _hear(self, ack: Ack) -> None:
        """Hear of newer weights; tell of the first work at once: this process may die soon."""
        self._weights.hear(ack)
        if ack.verdict == "accepted" and not self._has_worked:
            self._has_worked = True
            self._parent.report({"accepted": 1.0})

    def _ask(self, hello: Hello) -> bytes | None:
        if hello.spaces is not None:
            hello = replace(hello, next_seq=self._outbox.answered)
        return self._bus.ask(self._hello_key, encode(hello), _ASK_TIMEOUT_S)

    def _hello(self, hello: Hello) -> Welcome | None:
        while self._proceed():
            reply = self._ask(hello)
            if reply is not None:
                answer = decode(reply, Welcome, Refusal)
                if isinstance(answer, Refusal):
                    raise RefusedError(f"the learner refused this actor: {answer.reason}")
                assert isinstance(answer, Welcome)
                self._patience.over()
                return answer
            self._patience.wait_for(f"the learner of run {self._keys.run!r} to answer a hello")
            self._stopped.wait(_ASK_AGAIN_S)
        return None

    def _pull(self, *, beside: bool) -> Suggester | None:
        """Take newer weights once they are there; ``beside``: hardly wait for them."""
        patience_s = _LOOK_EVERY_S
        if beside:
            patience_s = 0.0 if self._weights.is_fetching else _BESIDE_S
        weights = self._weights.pull(patience_s)
        if weights is None:
            if not (beside or self._weights.is_fetching):
                self._stopped.wait(_ASK_AGAIN_S)
            return None
        before = self._notice
        if before is not None and before.identity == weights.notice.identity:
            return None
        self._notice = weights.notice
        if before is not None and weights.notice.epoch > before.epoch:
            self._metrics.recoveries.inc(weights.notice.epoch - before.epoch)
        self._metrics.weights_version.set(weights.notice.version)
        self._metrics.epoch.set(weights.notice.epoch)
        self._metrics.weights_received.set(time.time())
        self._metrics.weights_received_bytes.inc(len(weights.graph))
        return Suggester(weights.graph)

    def _may_play_on(self) -> bool:
        """Whether there are weights to play by: after a recovery those from before are none."""
        return self._notice is not None and not self._weights.overrules(self._notice)

    def _wait_for_weights(self) -> bool:
        self._patience.wait_for("new weights from the learner")
        return self._proceed()

    def _proceed(self) -> bool:
        return not self._stopped.is_set()

    def _beat(self) -> None:
        """Publish a status once a second, also while an environment keeps the actor waiting."""
        while not self._ended.wait(_STATUS_EVERY_S):
            self._parent.report(self._metrics.report())
            self._publish_status(leaving=False)

    def _publish_status(self, *, leaving: bool) -> None:
        if self._welcome is None:
            return
        doing = self._parent.activity.now()
        status = ActorStatus(
            actor=self._name,
            slot=self._welcome.slot,
            weights_version=self._notice.version if self._notice else 0,
            epoch=self._notice.epoch if self._notice else 0,
            env_steps=int(total(self._metrics.env_steps)),
            episodes=int(total(self._metrics.episodes)),
            segments_sent=self._rollout.segments_made if self._rollout else 0,
            segments_answered=self._outbox.answered,
            spooled_steps=self._outbox.steps,
            leaving=leaving,
            doing="" if doing is None else str(doing),
            dropped_steps=self._troubles.dropped_steps,
            trouble=self._troubles.latest,
            **{f"{doing}_s": seconds for doing, seconds in self._metrics.spent().items()},
        )
        self._bus.publish(self._keys.actor_status(self._name), encode(status))


def _require_made_for(told: Welcome, now: Welcome) -> None:
    """Raise A2SError if environments that were made as told are not what is wanted now."""
    offsets = [each.spaces.obs_offset for each in (told, now)]
    before, after = (b"" if each is None else each.tobytes() for each in offsets)
    if (told.env, before) != (now.env, after):
        raise A2SError(
            f"environment {now.env_id}: found another way to make it or another offset than "
            "before, expected the same; its process begins anew with what the learner wants now"
        )
