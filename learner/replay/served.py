"""The learner's replay for others: answers ``replay/info`` and ``replay/sample``."""

import threading
import time
from collections.abc import Callable

import numpy as np

from a2s.learner.replay.replay import Replay
from a2s.protocol.codec import decode, encode
from a2s.protocol.errors import A2SError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Refusal
from a2s.protocol.replay_messages import COLUMNS, ReplayInfo, ReplayRequest, ReplaySample
from a2s.protocol.transport import Bus

_SHARE = 0.25


class ServedReplay:
    """Answers who asks for transitions, one request at a time, in a bounded share of the time.

    After each answer it rests, so that however many ask and however much, the learner keeps the
    rest of a core; they wait for their turn, in their own time.

    Args:
        bus: The connection.
        keys: Of the run.
        replay: Where to sample; the learner goes on inserting and sampling.
        generation: Which start of the learner this is.
        share: Of the time that may go into answers, above 0 and up to 1.
        clock: Seconds, from anywhere.
        rest: Waits so many seconds.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        replay: Replay,
        generation: int,
        *,
        share: float = _SHARE,
        clock: Callable[[], float] = time.monotonic,
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self._bus = bus
        self._keys = keys
        self._replay = replay
        self._generation = generation
        self._rests = 1.0 / share - 1.0
        self._clock = clock
        self._rest = rest
        self._turn = threading.Lock()
        self._free_s = clock()

    def open(self) -> None:
        """Answer from now on."""
        self._bus.answer(self._keys.replay_info, self._on_info)
        self._bus.answer(self._keys.replay_sample, self._on_sample)

    def _on_info(self, payload: bytes) -> bytes:
        del payload
        about, live = self._replay.about, self._replay.live
        return encode(
            ReplayInfo(
                run=self._keys.run,
                generation=self._generation,
                env_id=about.env_id,
                spaces=about.spaces,
                capacity=about.capacity,
                begin=live.start,
                end=live.stop,
            )
        )

    def _on_sample(self, payload: bytes) -> bytes:
        with self._turn:
            begin_s = self._clock()
            if begin_s < self._free_s:
                self._rest(self._free_s - begin_s)
                begin_s = self._clock()
            try:
                return self._sample(decode(payload, ReplayRequest))
            except A2SError as error:
                return encode(Refusal(reason=str(error)))
            finally:
                end_s = self._clock()
                self._free_s = end_s + self._rests * (end_s - begin_s)

    def _sample(self, request: ReplayRequest) -> bytes:
        batch = self._replay.sample(
            request.batch_size,
            np.random.default_rng(request.seed),
            n_step=request.n_step,
            gamma=request.gamma,
            prioritised=request.prioritised,
            beta=request.beta,
        )
        columns = {
            name: getattr(batch, name) if name in request.fields else None for name in COLUMNS[:-1]
        }
        row = tuple(batch.row.tolist()) if "row" in request.fields else ()
        return encode(ReplaySample(begin=batch.begin, end=batch.end, row=row, **columns))
