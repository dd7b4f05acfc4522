"""Gathering: every hello and segment is judged here, and segments become batches here.

The handlers of the bus call in on their threads; the learner's loop waits in
:meth:`Gather.next_batch`. One lock guards all of it.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from a2s.learner.ingest.admission import Terms
from a2s.learner.ingest.ledger import Accounts, Ledger
from a2s.learner.ingest.members import Member, Roster
from a2s.learner.ingest.newcomers import Newcomers
from a2s.learner.run.metrics import LearnerMetrics
from a2s.protocol.errors import RunDirectoryError, one_line
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    Hello,
    Notice,
    Refusal,
    Segment,
    Verdict,
    Welcome,
)

logger = logging.getLogger(__name__)

_WAIT_S = 0.5
_SILENT_S = 30.0
_PATIENCE = 10
_MOST_REMEMBERED = 4096


class Gather:
    """Judges what arrives, and hands out batches.

    Args:
        terms: The run.
        ledger: Where answers are written down.
        metrics: Where they are counted.
        on_event: Told joins, leaves and refusals, with the lock held.
        keep: Stores an accepted segment before it is written down and acknowledged.
        hold_s: Seconds that an actor should wait while so many batches pend.
    """

    def __init__(
        self,
        terms: Terms,
        ledger: Ledger,
        metrics: LearnerMetrics,
        on_event: Callable[..., None],
        keep: Callable[[Segment], None],
        hold_s: Callable[[float], float],
    ) -> None:
        self._terms = terms
        self._ledger = ledger
        self._metrics = metrics
        self._on_event = on_event
        self._keep = keep
        self._hold_s = hold_s
        self._roster = Roster(terms.seed, terms.generation)
        self._newcomers = Newcomers()
        self._dropped: dict[str, int] = {}
        self._dropped_before = 0
        self._changed = threading.Condition()
        self._notice: Notice | None = None
        self._batch_steps = 1
        self._pending: list[tuple[int, Segment]] = []
        self._pending_steps = 0
        self._is_complete = False
        self._published_s = 0.0
        self._failure: RunDirectoryError | None = None

    # What the bus calls.

    def hello(self, hello: Hello) -> Welcome | Refusal:
        """Answer a hello; one with spaces joins."""
        terms = self._terms
        slot, seed = -1, terms.seed_before_joining
        if hello.spaces is None:
            with self._changed:
                self._newcomers.hear(hello.actor, time.monotonic())
        else:
            difference = terms.difference(hello)
            if difference:
                return self.refuse("hello", "environment", difference)
            with self._changed:
                is_new = self._roster.find(hello.actor) is None
                member, seed = self._roster.join(hello, time.monotonic())
                slot = member.slot
                if is_new:
                    self._newcomers.forget(hello.actor)
                    self._is_complete |= len(self._roster.members) >= terms.num_actors
                    self._metrics.joins.inc()
                    self._on_event("join", actor=hello.actor, slot=slot, envs=hello.num_envs)
                    if hello.cause:
                        reason = one_line(hello.cause)
                        self._on_event("restart", actor=hello.actor, slot=slot, reason=reason)
                        logger.warning("actor %s was replaced: %s", hello.actor, reason)
                self._changed.notify_all()
        return Welcome(
            run=terms.run,
            generation=terms.generation,
            env_id=terms.env_id,
            spaces=terms.spaces,
            num_envs=terms.num_envs,
            clock=terms.clock,
            slot=slot,
            seed=seed,
            env=terms.env,
        )

    def segment(self, segment: Segment) -> Ack:
        """Judge a segment; an accepted one is stored and written down before this returns.

        Raises:
            RunDirectoryError: It cannot be stored.
        """
        with self._changed:
            if self._ledger.has(segment.actor, segment.seq):
                return self._ack("duplicate", "answered before", segment)
            member = self._roster.find(segment.actor)
            if member is not None:
                member.heard_s = time.monotonic()
            elif segment.generation == self._terms.generation:
                self._metrics.refused.labels(message="segment", reason="unknown_actor").inc()
                return self._ack("unknown", f"actor {segment.actor} has not joined", segment)
            if self._ledger.leaps(segment.actor, segment.seq):
                return self.refuse_segment("future", f"seq {segment.seq} is far from the others")
            verdict, cause, reason = self._judge(segment, member)
            self._store(segment, verdict)
            if verdict == "refused":
                self._metrics.refused.labels(message="segment", reason=cause).inc()
                self._on_event("refusal", actor=segment.actor, seq=segment.seq, reason=reason)
            if verdict == "accepted":
                assert member is not None
                self._accept(segment, member)
            return self._ack(verdict, reason, segment)

    def refuse_segment(self, cause: str, reason: str) -> Ack:
        """Answer bytes that are no segment: nothing is known but that they are unusable."""
        self.refuse("segment", cause, reason)
        with self._changed:
            return self._ack("refused", reason, None)

    def refuse(self, message: str, cause: str, reason: str) -> Refusal:
        """Count a message that cannot be used."""
        with self._changed:
            self._metrics.refused.labels(message=message, reason=cause).inc()
            self._on_event("refusal", message=message, reason=reason)
        return Refusal(reason=reason)

    def status(self, status: ActorStatus) -> None:
        """Remember an actor's own account."""
        with self._changed:
            now_s = time.monotonic()
            status = replace(status, doing=one_line(status.doing), trouble=one_line(status.trouble))
            member = self._roster.find(status.actor)
            if member is None:
                if status.leaving:
                    self._newcomers.forget(status.actor)
                elif not self._roster.was_here(status.actor):
                    self._newcomers.hear(status.actor, now_s, status.doing)
                return
            if member.is_news(status):
                self._on_event("trouble", actor=status.actor, slot=member.slot, what=status.trouble)
                logger.warning("actor %s: %s", status.actor, status.trouble)
            self._count_dropped(status)
            member.status = status
            member.heard_s = now_s
            if status.leaving:
                self._leave(status.actor, "clean")

    def gone(self, actor: str) -> None:
        """An actor's connection has ended."""
        with self._changed:
            self._leave(actor, "lost")

    # What the learner's loop calls.

    def publish(self, notice: Notice, batch_steps: int) -> None:
        """New weights are out: count their quota from here, and forget what is now stale."""
        with self._changed:
            if self._notice is None or notice.epoch != self._notice.epoch:
                self._pending, self._pending_steps = [], 0
            self._notice, self._published_s = notice, time.monotonic()
            self._batch_steps = batch_steps
            self._roster.begin()

    def next_batch(self, proceed: Callable[[str], bool]) -> list[tuple[int, Segment]]:
        """Wait for a batch and take it.

        Args:
            proceed: Told what is waited for, at least twice a second; when false, the wait ends.

        Returns:
            Its segments, each with the slot of its actor, by slot, environment and number; empty
            when told not to proceed.

        Raises:
            RunDirectoryError: A segment could not be stored.
        """
        with self._changed:
            while self._failure is None and (missing := self._missing()) != "":
                if not proceed(missing):
                    return []
                self._changed.wait(timeout=_WAIT_S)
            if self._failure is not None:
                raise self._failure
            return self.take()

    def take(self) -> list[tuple[int, Segment]]:
        """Take what is there, in the order of a batch."""
        with self._changed:
            pending, self._pending, self._pending_steps = self._pending, [], 0
        pending.sort(key=lambda pair: (pair[0], pair[1].env, pair[1].seq))
        return pending

    def accounts(self) -> Accounts:
        """The segments of the run so far."""
        with self._changed:
            return self._ledger.accounts()

    @property
    def accepted_steps(self) -> int:
        """Environment steps accepted in the run so far."""
        return self._ledger.accepted_steps

    @property
    def dropped_steps(self) -> int:
        """Steps whose numbers could not be used, as actors told since this learner started."""
        with self._changed:
            return self._dropped_before + sum(self._dropped.values())

    @property
    def num_envs(self) -> int:
        """Environments of all actors present, or of those that are expected first."""
        with self._changed:
            expected = 0 if self._is_complete else self._terms.num_actors * self._terms.num_envs
            return max(1, expected, self._roster.num_envs)

    def members(self) -> list[Member]:
        """The actors present, by slot."""
        with self._changed:
            return self._roster.members

    def pending_steps(self) -> int:
        """Steps that wait to be learned from."""
        return self._pending_steps

    def _store(self, segment: Segment, verdict: Verdict) -> None:
        """Store and write down; if that fails nothing is answered, and the learner's loop ends."""
        if self._failure is not None:
            raise self._failure
        try:
            if verdict == "accepted":
                self._keep(segment)
            self._ledger.record(segment.actor, segment.seq, verdict, segment.num_steps)
        except RunDirectoryError as error:
            self._failure = error
            self._changed.notify_all()
            raise

    def _judge(self, segment: Segment, member: Member | None) -> tuple[Verdict, str, str]:
        generation = self._terms.generation
        if segment.generation != generation or member is None:
            return "stale", "", f"generation {segment.generation}, this is {generation}"
        misfit = self._terms.misfit(segment, member.num_envs)
        if misfit:
            return "refused", "spaces", misfit
        if self._notice is None or not 1 <= segment.weights_version <= self._notice.version:
            return "refused", "future", f"version {segment.weights_version} is not published"
        too_old = self._terms.too_old(segment, self._notice, self._pending_batches)
        return ("stale", "", too_old) if too_old else ("accepted", "", "")

    def _accept(self, segment: Segment, member: Member) -> None:
        assert self._notice is not None
        self._pending.append((member.slot, segment))
        self._pending_steps += segment.num_steps
        may_complete = self._terms.clock == "async"
        if segment.weights_version == self._notice.version:
            member.deliver(segment)
            if all(p.meets(self._notice) for p in member.progress):
                member.done_s = time.monotonic()
                may_complete = True
        self._metrics.policy_lag.observe(self._notice.version - segment.weights_version)
        self._metrics.env_steps.inc(segment.num_steps)
        if may_complete and not self._missing():
            self._changed.notify_all()

    def _ack(self, verdict: Verdict, reason: str, segment: Segment | None) -> Ack:
        steps = 0 if segment is None else segment.num_steps
        self._metrics.received.labels(result=verdict).inc(steps)
        # What is left of an earlier generation must go before its actor can join this one.
        is_ours = segment is not None and segment.generation == self._terms.generation
        return Ack(
            verdict=verdict,
            reason=reason,
            generation=self._terms.generation,
            epoch=self._notice.epoch if self._notice else 0,
            weights_version=self._notice.version if self._notice else 0,
            wait_s=self._wait_s() if is_ours else 0.0,
        )

    def _wait_s(self) -> float:
        """How long an actor should wait: too much to learn from is there already."""
        is_async = self._terms.clock == "async"
        return self._hold_s(self._pending_batches) if is_async else 0.0

    @property
    def _pending_batches(self) -> float:
        return self._pending_steps / self._batch_steps

    def _missing(self) -> str:
        """Say what a batch still waits for; empty when it is complete."""
        notice = self._notice
        if notice is None:
            return "the first weights"
        if not self._is_complete:
            more = self._terms.num_actors - len(self._roster.members)
            return f"{more} more of {self._terms.num_actors} actors: {self._coming()}"
        is_async = self._terms.clock == "async"
        if is_async and self._pending_steps >= self._batch_steps:
            return ""
        now_s = time.monotonic()
        present = self._roster.members
        members = [m for m in present if now_s - m.heard_s < _SILENT_S]
        if not members:
            silent = f"none of {len(present)} was heard for {_SILENT_S:.0f} s"
            return f"actors: {silent if present else 'none is present'}, {self._coming()}"
        if is_async:
            return f"{self._batch_steps - self._pending_steps} more steps{_doing(members)}"
        late = [m for m in members if not all(p.meets(notice) for p in m.progress)]
        done_s = [m.done_s - self._published_s for m in members if m not in late]
        if late and not (done_s and self._is_overdue(now_s, max(done_s))):
            slots = [m.slot for m in late]
            return f"segments of version {notice.version} from actors {slots}{_doing(late)}"
        return "" if self._pending else "segments"

    def _count_dropped(self, status: ActorStatus) -> None:
        self._dropped[status.actor] = status.dropped_steps
        if len(self._dropped) > _MOST_REMEMBERED:
            self._dropped_before += self._dropped.pop(next(iter(self._dropped)))

    def _coming(self) -> str:
        return self._newcomers.describe(time.monotonic()) or "start `a2s actor`"

    def _is_overdue(self, now_s: float, others_s: float) -> bool:
        """Whether those who are late have had ten times the time that all others needed."""
        return now_s - self._published_s > max(_SILENT_S, _PATIENCE * others_s)

    def _leave(self, actor: str, reason: str) -> None:
        self._newcomers.forget(actor)
        member = self._roster.leave(actor)
        if member is not None:
            self._metrics.leaves.labels(reason=reason).inc()
            self._on_event("leave", actor=actor, slot=member.slot, reason=reason)
            self._changed.notify_all()


def _doing(members: list[Member]) -> str:
    """Say which call into an environment keeps the first of some members, if one does."""
    for member in members:
        if member.status is not None and member.status.doing:
            return f", actor {member.slot}: {member.status.doing}"
    return ""
