"""Ingest: every hello and segment is judged here; what is accepted is stored and counted.

The handlers of the bus call in on their threads; the learner's loop waits in
:meth:`Ingest.next_batch`. One lock guards all of it.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from a2s.learner.feed import Arrival, Attendance, in_order
from a2s.learner.ingest.admission import Admission
from a2s.learner.ingest.clock import Round, clock_of
from a2s.learner.ingest.events import Events
from a2s.learner.ingest.journal import Begun, Journal
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.left_over import LeftOver
from a2s.learner.ingest.members import SILENT_S, Member, Members
from a2s.learner.ingest.store import Quota, Store
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
_MAX_USELESS = 100_000


class Ingest:
    """Judges what arrives, stores it, and says when a batch is complete.

    ``on_event`` gets joins, leaves and refusals. ``journal`` and ``store`` get accepted segments
    before they are written into the ``ledger`` and acknowledged. All are called with the lock held.
    ``left_over`` is for the first batch.
    """

    def __init__(
        self,
        admission: Admission,
        ledger: Ledger,
        metrics: LearnerMetrics,
        on_event: Callable[..., None],
        store: Store,
        journal: Journal,
        left_over: LeftOver,
    ) -> None:
        self._admission, self._clock = admission, clock_of(admission.run.clock)
        self._ledger, self._metrics = ledger, metrics
        self._event = Events(on_event, time.monotonic)
        self._store, self._journal, self._left_over = store, journal, left_over
        self._members = Members(admission.run.seed, admission.generation)
        self._changed = threading.Condition()
        self._round: Round | None = None
        self._longest = 0  # segment of all that the quotas so far allow
        self._useless = 0  # segments that were refused, or were for another learner
        self._usual_envs = admission.run.n * admission.run.envs
        self._has_begun = False
        self._failure: RunDirectoryError | None = None
        metrics.env_steps.inc(ledger.accepted_steps)  # of earlier starts

    def hello(self, hello: Hello) -> Welcome | Refusal | None:
        """Answer a hello; one with spaces joins. ``None``: its token has to be seen first."""
        admission = self._admission
        if hello.spaces is None:
            with self._changed:
                self._members.coming(hello.actor, time.monotonic())
            return admission.welcome(-1, admission.seed_before_joining)
        if difference := admission.difference(hello):
            return self.refuse("hello", "environment", difference)
        with self._changed:
            if not self._members.has_token(hello.actor):
                self._metrics.refused.labels(message="hello", reason="no_token").inc()
                self._members.coming(hello.actor, time.monotonic(), "joins without its token")
                return None
            if reason := self._members.no_room_for(hello):
                return self.refuse("hello", "full", reason)
            is_new = self._members.find(hello.actor) is None
            member, seed = self._members.join(hello, time.monotonic())
            if is_new:
                self._welcome(hello, member.slot)
                if self._round is not None:
                    self._left_over.deliver(member, self._round.notice)
            self._changed.notify_all()
        return admission.welcome(member.slot, seed)

    def segment(self, segment: Segment, payload: bytes) -> Ack:
        """Judge a segment; an accepted one is stored and written down before this returns.

        ``payload`` is what it came as.

        Raises:
            RunDirectoryError: It cannot be stored.
        """
        with self._changed:
            member = self._members.find(segment.actor)
            if member is not None:
                member.heard_s = time.monotonic()
            if known := self._not_judged(segment, member):
                return self._ack(*known, segment)
            if self._ledger.leaps(segment.actor, segment.seq):
                return self.refuse_segment("future", f"seq {segment.seq} is far from the others")
            verdict, cause, reason = self._admission.judge(
                segment,
                None if member is None else member.num_envs,
                None if self._round is None else self._round.notice,
                self._longest,
                is_flooded=self._round is not None and self._clock.is_flooded(self._round),
            )
            is_useless = verdict == "refused" or not self._admission.is_ours(segment)
            self._useless += is_useless
            if not is_useless or self._useless <= _MAX_USELESS:
                self._write_down(segment, payload, verdict, member)
            if verdict == "refused":
                self._metrics.refused.labels(message="segment", reason=cause).inc()
                self._event("refusal", cause, actor=segment.actor, seq=segment.seq, reason=reason)
            if verdict == "accepted":
                assert member is not None
                self._count(segment, member)
            return self._ack(verdict, reason, segment)

    def refuse_segment(self, cause: str, reason: str) -> Ack:
        """Answer bytes that are not a segment: nothing else is known of them."""
        self.refuse("segment", cause, reason)
        with self._changed:
            return self._ack("refused", reason, None)

    def refuse(self, message: str, cause: str, reason: str) -> Refusal:
        """Count an unusable message."""
        reason = one_line(reason)
        with self._changed:
            self._metrics.refused.labels(message=message, reason=cause).inc()
            self._event("refusal", f"{message} {cause}", message=message, reason=reason)
        return Refusal(reason=reason)

    def status(self, status: ActorStatus) -> None:
        """Remember an actor's latest status."""
        with self._changed:
            now_s = time.monotonic()
            status = replace(status, doing=one_line(status.doing), trouble=one_line(status.trouble))
            member = self._members.find(status.actor)
            if member is None:
                gives_up = self._members.hear_newcomer(status, now_s) and bool(status.trouble)
                if gives_up and self._event(
                    "trouble", actor=status.actor, slot=-1, what=status.trouble
                ):
                    logger.warning("actor %s cannot join: %s", status.actor, status.trouble)
                return
            if member.is_news(status) and self._event(
                "trouble", actor=status.actor, slot=member.slot, what=status.trouble
            ):
                logger.warning("actor %s: %s", status.actor, status.trouble)
            self._members.hear(member, status, now_s)
            if status.leaving:
                self._leave(status.actor, "clean")

    def here(self, actor: str) -> None:
        """An actor can be seen, or somebody else."""
        with self._changed:
            self._members.here(actor)

    def gone(self, actor: str) -> None:
        """An actor's connection has ended."""
        with self._changed:
            self._members.gone(actor)
            self._leave(actor, "lost")

    def quota(self, version: int, epoch: int) -> tuple[int, Quota]:
        """The number of environments that weights are for, and what those play by them.

        An actor that has begun with a quota finds the same one after a restart.
        """
        num_envs = self.num_envs
        quota = self._store.quota(num_envs)
        with self._changed:
            return num_envs, self._left_over.quota(version, epoch) or quota

    def begin(self, notice: Notice, quota: Quota, num_envs: int) -> None:
        """New weights are out for so many environments: count their quota from here.

        Segments of another epoch are forgotten.

        Raises:
            RunDirectoryError: It cannot be written down.
        """
        with self._changed:
            self._longest = max(self._longest, self._admission.longest(quota))
            self._journal.begin(Begun(notice.version, notice.epoch, num_envs, quota))
            before = self._round or self._left_over
            arrivals = before.arrivals
            if arrivals and before.epoch != notice.epoch:
                arrivals = []
                self._store.close_batch()  # and the next one takes its place
            self._round = Round(
                notice=notice,
                batch_steps=quota.batch_steps,
                published_s=time.monotonic(),
                arrivals=arrivals,
                steps=sum(arrival.num_steps for arrival in arrivals),
            )
            self._members.begin()
            for member in self._members.present:
                self._left_over.deliver(member, notice)

    def next_batch(self, proceed: Callable[[str], bool]) -> list[Arrival]:
        """Wait for a batch and take it; see :meth:`a2s.learner.feed.Feed.next_batch`.

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

    def take(self) -> list[Arrival]:
        """Take all that arrived, by slot, environment and number."""
        with self._changed:
            if self._round is None:
                return []
            arrivals, self._round.arrivals, self._round.steps = self._round.arrivals, [], 0
            if arrivals:
                self._journal.take(self._ledger.accepted_steps)
            self._store.close_batch()
        return in_order(arrivals)

    @property
    def num_envs(self) -> int:
        """Environments of all actors that are heard, or of those that are expected.

        At first that is the run's number, later as many as there were before all had left.
        """
        with self._changed:
            present = self._members.num_envs(time.monotonic())
            run = self._admission.run
            if not self._has_begun:
                return max(present, run.n * run.envs)
            self._usual_envs = present or self._usual_envs
            return self._usual_envs

    def attendance(self) -> Attendance:
        """Give the actors present, and the fate of their segments."""
        with self._changed:
            return Attendance(
                members=tuple(self._members.present),
                pending_steps=self._round.steps if self._round else 0,
                accounts=self._ledger.accounts(),
                dropped_steps=self._members.dropped_steps,
            )

    def close(self) -> None:
        """Close ledger and journal: what still arrives is not answered."""
        with self._changed:
            self._failure = self._failure or RunDirectoryError("the learner has ended")
            self._ledger.close()
            self._journal.close()

    def _welcome(self, hello: Hello, slot: int) -> None:
        self._has_begun |= len(self._members.present) >= self._admission.run.n
        self._metrics.joins.inc()
        self._event("join", actor=hello.actor, slot=slot, envs=hello.num_envs)
        if hello.cause:
            reason = one_line(hello.cause)
            if self._event("restart", actor=hello.actor, slot=slot, reason=reason):
                logger.warning("actor %s was replaced: %s", hello.actor, reason)

    def _not_judged(self, segment: Segment, member: Member | None) -> tuple[Verdict, str] | None:
        """The answer to a segment that was answered before, or has no right to be, or not yet."""
        actor, seq, cause, reason = segment.actor, segment.seq, "", ""
        is_known = self._ledger.has(actor, seq)
        if member is None:
            if self._admission.is_ours(segment) or not self._members.has_token(actor):
                cause, reason = "unknown_actor", f"actor {actor} has not joined"
        elif member.is_early(seq) and not is_known:
            cause, reason = "early", f"seq {seq} has overtaken {member.next_seq}"
        else:
            member.answer(seq)
        if is_known:
            return "duplicate", "answered before"
        if not cause:
            return None
        self._metrics.refused.labels(message="segment", reason=cause).inc()
        return "unknown", reason

    def _write_down(
        self, segment: Segment, payload: bytes, verdict: Verdict, member: Member | None
    ) -> None:
        """Store and write down; if that fails nothing is answered, and the learner's loop ends."""
        if self._failure is not None:
            raise self._failure
        try:
            if verdict == "accepted" and member is not None:
                self._journal.segment(member.slot, payload)
                self._store.store(member.slot, segment)
            self._ledger.record(segment.actor, segment.seq, verdict, segment.num_steps)
        except RunDirectoryError as error:
            self._failure = error
            self._changed.notify_all()
            raise

    def _count(self, segment: Segment, member: Member) -> None:
        played = self._round
        assert played is not None
        played.arrivals.append(Arrival.of(segment, member.slot))
        played.steps += segment.num_steps
        may_complete = self._clock.is_filled(played)
        member.has_sent(time.monotonic())
        if segment.weights_version == played.notice.version:
            member.deliver(segment)
            if member.has_delivered(played.notice):
                member.done_s = time.monotonic()
                may_complete = True
        self._metrics.policy_lag.observe(played.notice.version - segment.weights_version)
        self._metrics.env_steps.inc(segment.num_steps)
        if may_complete and not self._missing():
            self._changed.notify_all()

    def _ack(self, verdict: Verdict, reason: str, segment: Segment | None) -> Ack:
        self._metrics.received.labels(result=verdict).inc(segment.num_steps if segment else 0)
        generation, played = self._admission.generation, self._round
        wait_s = 0.0
        # Remains of an earlier generation must go before its actor can join this one.
        is_ours = segment is not None and self._admission.is_ours(segment)
        if is_ours and not self._clock.waits_for_weights:
            wait_s = self._store.hold_s(played.num_batches if played else 0.0)
        return Ack(
            verdict=verdict,
            reason=reason,
            generation=generation,
            epoch=played.notice.epoch if played else 0,
            weights_version=played.notice.version if played else 0,
            wait_s=wait_s,
        )

    def _missing(self) -> str:
        """Say what a batch still waits for; empty when it is complete."""
        if self._round is None:
            return "the first weights"
        now_s = time.monotonic()
        self._give_up(self._round, now_s)
        present = self._members.present
        if not self._has_begun:
            wanted = self._admission.run.n
            return f"{wanted - len(present)} more of {wanted} actors: {self._coming(now_s)}"
        if self._clock.is_filled(self._round):
            return ""
        heard = self._members.heard(now_s)
        if not heard:
            silent = f"none of {len(present)} was heard for {SILENT_S:.0f} s"
            return f"actors: {silent if present else 'none is present'}, {self._coming(now_s)}"
        return self._clock.missing(self._round, heard, now_s)

    def _give_up(self, played: Round, now_s: float) -> None:
        """Go on without members that report, but of whom nothing comes."""
        timeout_s = self._admission.run.env_timeout_s
        for member in self._clock.stalled(played, self._members.present, now_s, timeout_s):
            idle_s = member.idle_s(played.notice, played.published_s, now_s)
            doing = member.status.doing if member.status else ""
            logger.warning(
                "actor %s: nothing came of it for %.0f s%s; going on without it until it sends",
                member.actor, idle_s, doing and f" ({doing})",
            )  # fmt: skip
            self._leave(member.actor, "stalled")

    def _coming(self, now_s: float) -> str:
        coming = self._members.describe_newcomers(now_s)
        return coming or "start `a2s actor` unless it starts already"

    def _leave(self, actor: str, reason: str) -> None:
        member = self._members.leave(actor)
        if member is not None:
            self._metrics.leaves.labels(reason=reason).inc()
            self._event("leave", actor=actor, slot=member.slot, reason=reason)
            self._changed.notify_all()
