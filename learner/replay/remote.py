"""Another learner's replay, sampled over the network as if it were here."""

from typing import TypeVar

import numpy as np

from a2s.learner.replay.transitions import Transitions
from a2s.protocol.codec import Message, decode, encode
from a2s.protocol.errors import MalformedMessageError, RefusedError, UnreachableError
from a2s.protocol.fields import Array
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Refusal
from a2s.protocol.replay_messages import COLUMNS, Column, ReplayInfo, ReplayRequest, ReplaySample
from a2s.protocol.transport import Bus

_PATIENCE_S = 10.0

M = TypeVar("M", bound=Message)


class RemoteReplay:
    """A served replay; it can be read only.

    Args:
        bus: The connection.
        keys: Of the run whose learner serves it.
        timeout_s: How long to wait for an answer.
    """

    def __init__(self, bus: Bus, keys: Keys, timeout_s: float = _PATIENCE_S) -> None:
        self._bus = bus
        self._keys = keys
        self._timeout_s = timeout_s

    def info(self) -> ReplayInfo:
        """Ask what it holds now.

        Raises:
            UnreachableError: Nobody answers.
        """
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
        """Draw transitions, as :meth:`a2s.learner.replay.replay.Replay.sample` does.

        Raises:
            UnreachableError: Nobody answers.
            RefusedError: The learner says why not, for example because the replay is empty.
            MalformedMessageError: A number is out of its range, or the answer is not one.
        """
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
        return Transitions(
            obs=_column(sample, "obs"),
            action=_column(sample, "action"),
            reward=_column(sample, "reward"),
            next_obs=_column(sample, "next_obs"),
            discount=_column(sample, "discount"),
            weight=_column(sample, "weight"),
            row=np.array(sample.row, np.int64),
            begin=sample.begin,
            end=sample.end,
        )

    def ask(self, request: ReplayRequest) -> ReplaySample:
        """Draw just what is asked for.

        Raises:
            UnreachableError: Nobody answers.
            RefusedError: The learner says why not.
            MalformedMessageError: The answer is not one.
        """
        return self._ask(self._keys.replay_sample, encode(request), ReplaySample)

    def _ask(self, key: str, payload: bytes, kind: type[M]) -> M:
        answer = self._bus.ask(key, payload, self._timeout_s)
        if answer is None:
            raise UnreachableError(
                f"{key}: no answer; is the run {self._keys.run!r} off-policy, and its learner up?"
            )
        found: M | Refusal = decode(answer, kind, Refusal)
        if isinstance(found, Refusal):
            raise RefusedError(f"{key}: the learner refused: {found.reason}")
        return found


def _column(sample: ReplaySample, name: Column) -> Array:
    array: Array | None = getattr(sample, name)
    if array is None:
        raise MalformedMessageError(f"replay sample: {name}: found nothing, expected an array")
    return array.copy()  # what was decoded cannot be written to, and torch warns of that
