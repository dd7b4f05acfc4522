"""The newest weights: a graph, its notice, and the answers to who asks for them."""

import hashlib
import threading

from a2s.protocol.codec import encode
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Notice, Weights
from a2s.protocol.transport import Bus


class Publisher:
    """Announces weights, and keeps the newest for those who pull.

    Args:
        bus: The connection.
        keys: Of the run.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus = bus
        self._keys = keys
        self._lock = threading.Lock()
        self._notice = b""
        self._weights = b""
        self._prepared = b"", b""
        bus.answer(keys.notice, lambda _: self._newest()[0])
        bus.answer(keys.weights, lambda _: self._newest()[1])

    def _newest(self) -> tuple[bytes, bytes]:
        with self._lock:
            return self._notice, self._weights

    def prepare(
        self, graph: bytes, *, generation: int, epoch: int, version: int, quota: tuple[int, int]
    ) -> Notice:
        """Make the notice of a graph; nobody sees either before :meth:`announce`.

        Args:
            graph: ONNX bytes.
            generation: Which start of the learner this is.
            epoch: Recoveries so far.
            version: Number of these weights.
            quota: Steps and whole episodes that each environment plays.
        """
        notice = Notice(
            generation=generation,
            epoch=epoch,
            version=version,
            quota_steps=quota[0],
            quota_episodes=quota[1],
            num_bytes=len(graph),
            sha256=hashlib.sha256(graph).hexdigest(),
        )
        self._prepared = encode(notice), encode(Weights(notice=notice, graph=graph))
        return notice

    def announce(self) -> None:
        """Serve what was prepared, and tell everybody who listens."""
        with self._lock:
            self._notice, self._weights = self._prepared
        self._bus.publish(self._keys.notice, self._notice)
