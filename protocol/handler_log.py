"""What goes wrong in handlers of messages, in the log: ten of a kind in a minute."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from a2s.protocol.allowance import FEW, Allowance
from a2s.protocol.errors import A2SError

logger = logging.getLogger(__name__)


class HandlerLog:
    """Logs what handlers raise, on whatever threads; ``clock`` gives seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._allowance, self._lock = clock, Allowance(), threading.Lock()

    @contextmanager
    def of(self, key: str) -> Iterator[None]:
        """Log what the handler of ``key`` raises in this block, unless there was too much of it."""
        try:
            yield
        except Exception as error:  # zenoh's thread would print it and go on; it belongs in our log
            with self._lock:
                left_out = self._allowance.take((key, type(error)), FEW, self._clock())
            if left_out is None:
                return
            more = f" ({left_out:,} like it were left out before)" if left_out else ""
            if isinstance(error, A2SError):  # its one line says all
                logger.error("%s%s", error, more)  # noqa: TRY400
            else:
                logger.exception("handler failed key=%s%s", key, more)
