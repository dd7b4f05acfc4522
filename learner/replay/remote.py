"""A replay over the network: the learner's server, and the client that samples it."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from a2s.learner.replay.replay import Replay
from a2s.learner.replay.sampling import Transitions
from a2s.protocol.codec import Message, decode, encode
from a2s.protocol.errors import A2SError, MalformedMessageError, RefusedError, UnreachableError
from a2s.protocol.fields import Array
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Refusal
from a2s.protocol.replay_messages import COLUMNS, ReplayInfo, ReplayRequest, ReplaySample
from a2s.protocol.transport import Bus

_TIMEOUT_S = 10.0
_PATIENCE_S = 60.0
_LONGEST_REST_S = _TIMEOUT_S / 2  # the peer that is next waits no longer than the timeout
_RETRY_S = 0.5
_MAX_WAITING = 32

M = TypeVar("M", bound=Message)


class ServedReplay:
    """Answers requests for transitions, one at a time, in a bounded share of the time.

    After each answer it rests, for 5 s at most, so that under any load the learner keeps the rest
    of a core; requests wait for their turn, or are refused for now if many do. ``share`` is the
    part of the time for answers, above 0 and up to 1; ``clock`` gives seconds and ``rest`` waits
    for seconds.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        replay: Replay,
        generation: int,
        *,
        share: float = 0.25,
        clock: Callable[[], float] = time.monotonic,
        rest: Callable[[float], object] = time.sleep,
    ) -> None:
        self._bus = bus
        self._keys = keys
        self._replay = replay
        self._generation = generation
        self._rest_per_answer = 1.0 / share - 1.0
        self._clock = clock
        self._rest = rest
        self._turn = threading.Lock()
        self._free_s = clock()

    def open(self) -> None:
        """Answer from now on."""
        busy = f"{_MAX_WAITING} requests wait already; ask again in {_RETRY_S:g} s"
        refusal = encode(Refusal(reason=busy, retry_s=_RETRY_S))
        sample = self._keys.replay_sample
        self._bus.answer_in_turn(sample, self._on_sample, lambda: refusal, _MAX_WAITING)
        # Last: who has been told what there is can sample it.
        self._bus.answer(self._keys.replay_info, self._on_info)

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
                rest_s = self._rest_per_answer * (end_s - begin_s)
                self._free_s = end_s + min(_LONGEST_REST_S, rest_s)

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


class RemoteReplay:
    """The replay that the learner of another run serves, read only."""

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus = bus
        self._keys = keys

    def info(self) -> ReplayInfo:
        """Ask for its present contents; raises as `ask` does."""
        return self._ask(self._keys.replay_info, b"", ReplayInfo)

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        *,
        n_step: int = 1,
        gamma: float = 0.99,
        prioritised: bool = False,
        beta: float = 0.4,
    ) -> Transitions:
        """Draw transitions as `Replay.sample` does; raises as `ask` does."""
        request = ReplayRequest(
            batch_size=batch_size,
            seed=int(rng.integers(1 << 63)),
            n_step=n_step,
            gamma=gamma,
            prioritised=prioritised,
            beta=beta,
            fields=COLUMNS,
        )
        sample = self.ask(request)
        columns = {name: _column(sample, name) for name in COLUMNS[:-1]}
        row = np.array(sample.row, np.int64)
        return Transitions(row=row, begin=sample.begin, end=sample.end, **columns)

    def ask(self, request: ReplayRequest) -> ReplaySample:
        """Draw just the requested fields.

        Raises:
            UnreachableError: Nobody answers.
            RefusedError: The learner refuses, for example because the replay is empty.
            MalformedMessageError: The answer cannot be read.
        """
        return self._ask(self._keys.replay_sample, encode(request), ReplaySample)

    def _ask(self, key: str, payload: bytes, kind: type[M]) -> M:
        begin_s = time.monotonic()
        while True:
            answer = self._bus.ask(key, payload, _TIMEOUT_S)
            if answer is None:
                raise UnreachableError(
                    f"{key}: no answer; is the run {self._keys.run!r} off-policy, and its learner "
                    "up?"
                )
            found: M | Refusal = decode(answer, kind, Refusal)
            if not isinstance(found, Refusal):
                return found
            if not found.retry_s or time.monotonic() - begin_s > _PATIENCE_S:
                raise RefusedError(f"{key}: the learner refused: {found.reason}")
            time.sleep(found.retry_s)


def _column(sample: ReplaySample, name: str) -> Array:
    array: Array | None = getattr(sample, name)
    if array is None:
        raise MalformedMessageError(f"replay sample: {name}: found nothing, expected an array")
    return array.copy()  # what was decoded cannot be written to, and torch warns of that
