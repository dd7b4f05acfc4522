"""Acting: several environments, one batched call for all of them, segments out."""

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from a2s.actors.environment import Environment
from a2s.actors.metrics import Tally
from a2s.actors.suggester import Choice, Suggester
from a2s.protocol.errors import A2SError, MalformedMessageError
from a2s.protocol.fields import Array
from a2s.protocol.messages import Notice, Segment

_MALFORMED_IN_A_ROW = 10


class _Slot:
    """One environment and the steps of its segment so far."""

    def __init__(self, environment: Environment, seed: int) -> None:
        self.environment = environment
        self.obs = environment.reset(seed)
        self.episode_return = 0.0
        self.episode_length = 0
        self.malformed = 0
        self.begin_quota()
        self.begin_segment()

    def begin_quota(self) -> None:
        self.quota_steps = 0
        self.quota_episodes = 0

    def begin_segment(self) -> None:
        self.rows: list[tuple[Array, Array, float, float]] = []

    def begin_episode(self) -> None:
        self.obs = self.environment.reset()
        self.episode_return = 0.0
        self.episode_length = 0


class Rollout:
    """Plays B environments with whatever weights it is given.

    Use::

        for segment in rollout.play(suggester, notice, interrupted):
            spool.put(segment)

    Args:
        actor: Name to send under.
        environments: At least one; the rollout resets them.
        seed: Seeds the environments and the suggestions' noise.
        tally: Where steps, episodes and times are counted.
    """

    def __init__(
        self,
        actor: str,
        environments: Sequence[Environment],
        seed: int,
        tally: Tally,
    ) -> None:
        *env_seeds, noise_seed = np.random.SeedSequence(seed).generate_state(len(environments) + 1)
        self._actor = actor
        self._slots = [
            _Slot(environment, int(env_seed))
            for environment, env_seed in zip(environments, env_seeds, strict=True)
        ]
        self._rng = np.random.default_rng(noise_seed)
        self._tally = tally
        self._seq = 0

    @property
    def segments_made(self) -> int:
        """Segments yielded since the beginning."""
        return self._seq

    def play(
        self, suggester: Suggester, notice: Notice, interrupted: Callable[[], bool]
    ) -> Iterator[Segment]:
        """Play the quota of one version in every environment.

        Every environment makes ``quota_steps`` steps; with ``quota_episodes`` it goes on to the
        end of the episode in which both are reached. Episodes go on across calls.

        Args:
            suggester: The weights.
            notice: What they are, and the quota.
            interrupted: Asked before every step; when true, what has been played is yielded.

        Yields:
            Segments, as soon as each is complete.
        """
        playing = list(range(len(self._slots)))
        for slot in self._slots:
            slot.begin_quota()
        while playing and not interrupted():
            choice = self._choose(suggester, playing)
            begin = time.perf_counter()
            for row, index in enumerate(playing):
                yield from self._step(index, choice, row, notice)
            spent = time.perf_counter() - begin
            self._tally.count("env_steps", len(playing))
            self._tally.observe("env_step_seconds", spent / len(playing))
            playing = [i for i in playing if not self._quota_is_met(self._slots[i], notice)]
        for index in range(len(self._slots)):
            yield from self._cut(index, notice, terminated=False, truncated=False)

    def _choose(self, suggester: Suggester, playing: list[int]) -> Choice:
        begin = time.perf_counter()
        obs = np.stack([self._slots[i].obs for i in playing])
        choice = suggester(obs, self._rng)
        self._tally.observe("select_seconds", time.perf_counter() - begin)
        self._tally.gauge("suggestion_q_spread", float(choice.q_spread.mean()))
        return choice

    def _step(self, index: int, choice: Choice, row: int, notice: Notice) -> Iterator[Segment]:
        slot = self._slots[index]
        obs, reward, terminated, truncated = slot.environment.step(choice.action[row])
        slot.rows.append((slot.obs, choice.suggestion[row], choice.log_prob[row], reward))
        slot.obs = obs
        slot.episode_return += reward
        slot.episode_length += 1
        slot.quota_steps += 1
        if terminated or truncated:
            self._tally.episode(slot.episode_return, slot.episode_length, terminated=terminated)
            yield from self._cut(index, notice, terminated=terminated, truncated=truncated)
            if slot.episode_length:
                slot.begin_episode()

    @staticmethod
    def _quota_is_met(slot: _Slot, notice: Notice) -> bool:
        if slot.quota_steps < notice.quota_steps:
            return False
        if notice.quota_episodes == 0:
            return True
        return slot.quota_episodes >= notice.quota_episodes and slot.episode_length == 0

    def _cut(
        self, index: int, notice: Notice, *, terminated: bool, truncated: bool
    ) -> Iterator[Segment]:
        slot = self._slots[index]
        if not slot.rows:
            return
        obs, suggestion, log_prob, reward = zip(*slot.rows, strict=True)
        slot.begin_segment()
        try:
            segment = Segment(
                actor=self._actor,
                seq=self._seq,
                generation=notice.generation,
                epoch=notice.epoch,
                weights_version=notice.version,
                env=index,
                obs=np.stack(obs),
                suggestion=np.stack(suggestion),
                log_prob=np.array(log_prob, dtype=np.float32),
                reward=np.array(reward, dtype=np.float32),
                final_obs=slot.obs,
                terminated=terminated,
                truncated=truncated,
                episode_return=slot.episode_return,
                episode_length=slot.episode_length,
            )
        except MalformedMessageError as error:
            self._drop(slot, len(reward), error)
            return
        slot.malformed = 0
        slot.quota_episodes += segment.ends_episode
        self._seq += 1
        yield segment

    def _drop(self, slot: _Slot, steps: int, error: MalformedMessageError) -> None:
        """Forget an episode with unusable numbers; if all are such, the environment is broken."""
        self._tally.count("dropped_transitions", steps, reason="malformed")
        slot.malformed += 1
        slot.quota_steps -= steps
        slot.begin_episode()
        if slot.malformed >= _MALFORMED_IN_A_ROW:
            raise A2SError(
                f"environment: {_MALFORMED_IN_A_ROW} unusable segments in a row, last: {error}"
            )
