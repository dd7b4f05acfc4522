"""The newest weights: announced by the learner, remembered here, fetched on demand."""

import hashlib
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

from a2s.protocol.codec import decode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Notice, Weights
from a2s.protocol.transport import Bus

_ASK_TIMEOUT_S = 5.0
_FETCH_TIMEOUT_S = 60.0  # begun anew on a slow link, it would come behind what is on its way
_ASK_EVERY_S = 1.0


class WeightsClient:
    """Keeps the newest notice, and fetches the weights that it announces.

    An announcement can be lost, so a waiting actor also asks, once a second. An announcement
    older than the known notice came late and is ignored. An answer is always taken: if it is older,
    it comes from another learner, which does not know what the one before had published.

    Weights are fetched on a thread of their own: who does not want to wait for them plays on.

    Anybody can announce. That the learner has restarted or recovered is believed only when it says
    so itself; other announcements are tried by fetching the weights.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus = bus
        self._keys = keys
        self._changed = threading.Condition()
        self._notice: Notice | None = None
        self._is_answer = False  # the notice is what the learner has answered
        self._generation: int | None = None  # of its latest answer
        self._claim = (0, 0)  # greatest generation and epoch of an acknowledgement, until asked
        self._asking = True
        self._thread = ThreadPoolExecutor(1, "weights")
        self._fetch: Future[Weights | None] | None = None
        bus.subscribe(keys.notice, lambda payload: self._hear_of(decode(payload, Notice)))

    def hear(self, ack: Ack) -> None:
        """Request the notice if an acknowledgement names newer weights, or those of another."""
        with self._changed:
            known = self._notice
            self._claim = max(self._claim, (ack.generation, ack.epoch))
            is_other = known is None or ack.generation != known.generation
            if is_other or (known is not None and ack.weights_version > known.version):
                self._asking = True
                self._changed.notify_all()

    def forget(self) -> None:
        """Forget the notice, and request it; forget what is being fetched."""
        self._fetch = None
        with self._changed:
            self._notice, self._is_answer, self._asking = None, False, True

    def overrules(self, notice: Notice) -> bool:
        """Whether the learner has recovered or restarted since these weights.

        If somebody has announced that, or an acknowledgement has told it, the learner is asked;
        without its word it is forgotten.
        """
        playing = (notice.generation, notice.epoch)
        with self._changed:
            known, is_answer, claim = self._notice, self._is_answer, self._claim
        if known is None:
            return False
        heard = (known.generation, known.epoch)
        if max(heard, claim) <= playing:
            return False
        if not (is_answer and heard > playing):
            answer = self._ask()
            with self._changed:
                self._claim = (0, 0)
                if answer is None:
                    self._notice, self._asking = notice, True
                    return False
            known = answer
        return known.generation != notice.generation or known.epoch > notice.epoch

    def other_than(self, notice: Notice | None, proceed: Callable[[], bool]) -> Notice | None:
        """Wait for weights other than these (``None``: for any); give their notice.

        ``proceed`` is called at least once a second; when it is false, the wait ends with ``None``.
        """
        known = None if notice is None else notice.identity
        while proceed():
            with self._changed:
                asking, self._asking = self._asking, False
            if asking:
                self._ask()
            with self._changed:
                found = self._notice
                if found is not None and found.identity != known and self._is_credible(found):
                    return found
                if not self._asking and not self._changed.wait(timeout=_ASK_EVERY_S):
                    self._asking = True
        return None

    @property
    def is_fetching(self) -> bool:
        """Whether weights are on their way."""
        return self._fetch is not None

    def pull(self, patience_s: float) -> Weights | None:
        """Give the newest weights, or ``None`` if they do not come in this time.

        Then they are still on their way, for a later call; or there was no answer, or its bytes
        were damaged.
        """
        fetch = self._fetch = self._fetch or self._thread.submit(self._pull)
        if not wait([fetch], patience_s).done:
            return None
        self._fetch = None
        return fetch.result()

    def _pull(self) -> Weights | None:
        known = self._notice
        reply = self._bus.fetch(self._keys.weights, _FETCH_TIMEOUT_S)
        if not reply:
            return None
        try:
            weights = decode(reply, Weights)
        except MalformedMessageError:
            return None
        if hashlib.sha256(weights.graph).hexdigest() != weights.notice.sha256:
            return None
        self._believe(weights.notice, known)
        return weights

    def _ask(self) -> Notice | None:
        known = self._notice
        reply = self._bus.ask(self._keys.notice, b"", _ASK_TIMEOUT_S)
        if not reply:
            return None
        answer = decode(reply, Notice)
        self._believe(answer, known)
        return answer

    def _hear_of(self, notice: Notice) -> None:
        """Keep a notice that is newer than the known one."""
        with self._changed:
            known = self._notice
            if known is None or notice.identity > known.identity:
                self._notice, self._is_answer = notice, False
                self._asking |= not self._is_credible(notice)
                self._changed.notify_all()

    def _believe(self, answer: Notice, known: Notice | None) -> None:
        """Keep an answer, unless something newer was heard of since the question."""
        with self._changed:
            self._generation = answer.generation
            newest = self._notice
            if newest is known or newest is None or answer.identity > newest.identity:
                self._notice, self._is_answer = answer, True
                self._changed.notify_all()

    def _is_credible(self, notice: Notice) -> bool:
        return self._is_answer or notice.generation == self._generation
