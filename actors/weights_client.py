"""The newest weights: announced by the learner, remembered here, fetched on demand."""

import hashlib
import threading
from collections.abc import Callable

from a2s.protocol.codec import decode
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Notice, Weights
from a2s.protocol.transport import Bus

_ASK_TIMEOUT_S = 5.0
_ASK_EVERY_S = 1.0


class WeightsClient:
    """Keeps the newest notice, and fetches the weights that it announces.

    An announcement can be lost, so a waiting actor also asks, once a second. An announcement
    older than the known notice came late and is ignored. An answer is always taken: if it is older,
    it comes from another learner, which does not know what the one before had published.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus = bus
        self._keys = keys
        self._changed = threading.Condition()
        self._notice: Notice | None = None
        self._asking = True
        bus.subscribe(keys.notice, lambda payload: self._take(decode(payload, Notice)))

    def hear(self, ack: Ack) -> None:
        """Request the notice if an acknowledgement names other weights."""
        with self._changed:
            known = self._notice
            if known is None or (ack.generation, ack.weights_version) != known.identity:
                self._asking = True
                self._changed.notify_all()

    def forget(self) -> None:
        """Forget the notice, and request it."""
        with self._changed:
            self._notice, self._asking = None, True

    def overrules(self, notice: Notice) -> bool:
        """Whether the learner has recovered or restarted since these weights."""
        known = self._notice
        return known is not None and (
            (known.generation, known.epoch) > (notice.generation, notice.epoch)
        )

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
                if self._notice is not None and self._notice.identity != known:
                    return self._notice
                if not self._asking and not self._changed.wait(timeout=_ASK_EVERY_S):
                    self._asking = True
        return None

    def pull(self) -> Weights | None:
        """Fetch the newest weights; ``None`` if there is no answer, or its bytes are damaged."""
        known = self._notice
        reply = self._bus.ask(self._keys.weights, b"", _ASK_TIMEOUT_S)
        if not reply:
            return None
        try:
            weights = decode(reply, Weights)
        except MalformedMessageError:
            return None
        if hashlib.sha256(weights.graph).hexdigest() != weights.notice.sha256:
            return None
        self._take(weights.notice, known)
        return weights

    def _ask(self) -> None:
        known = self._notice
        reply = self._bus.ask(self._keys.notice, b"", _ASK_TIMEOUT_S)
        if reply:
            self._take(decode(reply, Notice), known)

    def _take(self, notice: Notice, overruled: Notice | None = None) -> None:
        """Keep a notice that is newer than the known one, or answers in its place."""
        with self._changed:
            known = self._notice
            if known is None or known is overruled or notice.identity > known.identity:
                self._notice = notice
                self._changed.notify_all()
