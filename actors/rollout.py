"""Acting: several environments, one batched call for all of them, segments out."""

from collections.abc import Callable, Iterator, Sequence
from time import perf_counter

import numpy as np

from a2s.actors.environments.environment import Environment
from a2s.actors.environments.making import MOST_SEED, seed_globals
from a2s.actors.metrics import Tally
from a2s.actors.suggester import Choice, Suggester
from a2s.actors.troubles import Troubles
from a2s.protocol.codec import MAX_BYTES, MIB
from a2s.protocol.errors import FaultyEnvironmentError, MalformedMessageError
from a2s.protocol.fields import Array
from a2s.protocol.messages import MAX_PLAYED, EpisodeMetric, Notice, Segment

_USELESS_IN_A_ROW = 10
_SEGMENT_BYTES = MAX_BYTES[Segment] - MIB  # the rest is for what is not rows
_FLOAT_BYTES = 4
# An episode of a batch of whole ones is cut after so many steps, if nothing else ever ends it.
ENDLESS_STEPS = 10_000
_NOTHING: Iterator[Segment] = iter(())


class _Slot:
    """One environment and the steps of its segment so far."""

    def __init__(self, environment: Environment, seed: int) -> None:
        self.environment = environment
        self.useless = 0
        self.begin_quota()
        self.begin_segment()
        self.begin_episode(seed)

    def begin_quota(self) -> None:
        self.quota_steps = 0
        self.quota_episodes = 0

    def begin_segment(self) -> None:
        self.rows: list[tuple[Array, Array, float, float]] = []

    def begin_episode(self, seed: int | None = None) -> None:
        self.obs = self.environment.reset(seed)
        self.episode_return = 0.0
        self.episode_length = 0


class Rollout:
    """Plays B environments with whatever weights it is given.

    Use::

        for segment in rollout.play(suggester, notice, interrupted):
            spool.put(segment)

    A step whose numbers cannot be sent is dropped and the episode cut before it; what is dropped
    is made up for, so that the quota is always delivered.

    Args:
        actor: Name to send under.
        environments: At least one; the rollout resets them.
        seed: Seeds the environments, ``random``, ``np.random`` and the suggestions' noise.
        tally: Where steps, episodes and times are counted.
        troubles: Told what is dropped and cut.
    """

    def __init__(
        self,
        actor: str,
        environments: Sequence[Environment],
        seed: int,
        tally: Tally,
        troubles: Troubles,
    ) -> None:
        drawn = np.random.SeedSequence(seed).generate_state(len(environments) + 1)
        *env_seeds, noise_seed = drawn & MOST_SEED
        seed_globals(int(noise_seed))
        self._actor = actor
        self._slots = [
            _Slot(environment, int(env_seed))
            for environment, env_seed in zip(environments, env_seeds, strict=True)
        ]
        self._rng = np.random.default_rng(noise_seed)
        self._tally = tally
        self._troubles = troubles
        self._seq = 0
        spaces = environments[0].spaces
        row_bytes = _FLOAT_BYTES * (spaces.obs_size + spaces.action_size + 2)
        room = _SEGMENT_BYTES - _FLOAT_BYTES * spaces.obs_size  # for the last observation
        self._most_rows = max(1, room // row_bytes)

    @property
    def segments_made(self) -> int:
        """Segments yielded since the beginning."""
        return self._seq

    def play(
        self, suggester: Suggester, notice: Notice, interrupted: Callable[[], bool]
    ) -> Iterator[Segment]:
        """Play the quota of one version in every environment.

        Every environment makes ``quota_steps`` steps that can be sent; with ``quota_episodes`` it
        goes on to the end of the episode in which both are reached. Episodes go on across calls.

        Args:
            suggester: The weights.
            notice: What they are, and the quota.
            interrupted: Asked before every step; when true, what has been played is yielded.

        Yields:
            Segments, as soon as each is complete.

        Raises:
            FaultyEnvironmentError: An environment raised, or gives nothing that can be used.
        """
        playing = list(range(len(self._slots)))
        for slot in self._slots:
            slot.begin_quota()
        while playing and not interrupted():
            obs = np.array([self._slots[i].obs for i in playing])
            if not is_usable(obs):
                yield from self._drop_unusable(playing, notice)
                continue
            choice = self._choose(suggester, obs)
            begin = perf_counter()
            for row, index in enumerate(playing):
                yield from self._step(index, choice, row, notice)
            spent = perf_counter() - begin
            self._tally.count("env_steps", len(playing))
            self._tally.observe("env_step_seconds", spent / len(playing))
            met = [i for i in playing if self._quota_is_met(self._slots[i], notice)]
            if not met:
                continue
            for index in met:
                yield from self._finish_quota(index, notice)
            playing = [i for i in playing if not self._quota_is_met(self._slots[i], notice)]
        yield from self._drop_unusable(range(len(self._slots)), notice)
        for index in range(len(self._slots)):
            yield from self._cut(index, notice, terminated=False, truncated=False)

    def _finish_quota(self, index: int, notice: Notice) -> Iterator[Segment]:
        """Send what is left of a quota that is met; what turns out unusable has to be played."""
        yield from self._drop_unusable([index], notice)
        if self._quota_is_met(self._slots[index], notice):
            yield from self._cut(index, notice, terminated=False, truncated=False)

    def _choose(self, suggester: Suggester, obs: Array) -> Choice:
        begin = perf_counter()
        choice = suggester(obs, self._rng)
        self._tally.observe("select_seconds", perf_counter() - begin)
        self._tally.gauge("suggestion_q_spread", float(choice.q_spread.mean()))
        return choice

    def _step(self, index: int, choice: Choice, row: int, notice: Notice) -> Iterator[Segment]:
        """Make a step in one environment; gives the segments that end with it."""
        slot = self._slots[index]
        obs, reward, terminated, truncated = slot.environment.step(choice.action[row])
        if not -MAX_PLAYED <= reward <= MAX_PLAYED:  # false for NaN as well
            return self._abandon(index, notice, f"reward is {reward:g}", 1)
        slot.rows.append((slot.obs, choice.suggestion[row], choice.log_prob[row], reward))
        slot.episode_return += reward
        slot.episode_length += 1
        slot.quota_steps += 1
        if terminated and not is_usable(obs):
            obs = slot.obs  # nobody looks at it: the value of a terminal state is 0
        slot.obs = obs
        if terminated or truncated:
            return self._end(index, notice, terminated=terminated, truncated=truncated)
        if notice.quota_episodes and self._is_endless(slot):
            self._troubles.cut(slot.environment.name, slot.episode_length)
            return self._end(index, notice, terminated=False, truncated=True)
        if len(slot.rows) >= self._most_rows and is_usable(obs):
            return self._cut(index, notice, terminated=False, truncated=False)
        return _NOTHING

    def _end(
        self, index: int, notice: Notice, *, terminated: bool, truncated: bool
    ) -> Iterator[Segment]:
        """End the episode with its latest step."""
        slot = self._slots[index]
        if not is_usable(slot.obs):
            yield from self._drop_unusable([index], notice)
            return
        self._tally.episode(slot.episode_return, slot.episode_length, terminated=terminated)
        yield from self._cut(
            index,
            notice,
            terminated=terminated,
            truncated=truncated,
            metrics=slot.environment.metrics(),
        )
        slot.begin_episode()

    @staticmethod
    def _is_endless(slot: _Slot) -> bool:
        return slot.environment.episode_limit is None and slot.episode_length >= ENDLESS_STEPS

    @staticmethod
    def _quota_is_met(slot: _Slot, notice: Notice) -> bool:
        if slot.quota_steps < notice.quota_steps:
            return False
        if notice.quota_episodes == 0:
            return True
        return slot.quota_episodes >= notice.quota_episodes and slot.episode_length == 0

    def _drop_unusable(self, indices: Sequence[int], notice: Notice) -> Iterator[Segment]:
        """Drop the latest step of environments whose observation cannot be used."""
        for index in indices:
            slot = self._slots[index]
            obs, is_step = slot.obs, bool(slot.rows)
            if is_usable(obs):
                continue
            if is_step:
                slot.obs, _, _, reward = slot.rows.pop()
                slot.episode_return -= reward
                slot.episode_length -= 1
                slot.quota_steps -= 1
            bad = int(np.flatnonzero(~(np.abs(obs) <= MAX_PLAYED))[0])
            what = f"observation {bad} is {obs[bad]:g}"
            yield from self._abandon(index, notice, what, int(is_step))

    def _abandon(self, index: int, notice: Notice, what: str, steps: int) -> Iterator[Segment]:
        """Cut the episode after the steps that can be used, and begin another."""
        slot = self._slots[index]
        self._count_dropped(slot, steps, what, is_useless=not slot.rows)
        if slot.rows:
            self._tally.episode(slot.episode_return, slot.episode_length, terminated=False)
        yield from self._cut(index, notice, terminated=False, truncated=True)
        slot.begin_episode()

    def _cut(
        self,
        index: int,
        notice: Notice,
        *,
        terminated: bool,
        truncated: bool,
        metrics: tuple[EpisodeMetric, ...] = (),
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
                obs=np.array(obs),
                suggestion=np.array(suggestion),
                log_prob=np.array(log_prob, dtype=np.float32),
                reward=np.array(reward, dtype=np.float32),
                final_obs=slot.obs,
                terminated=terminated,
                truncated=truncated,
                episode_return=slot.episode_return,
                episode_length=slot.episode_length,
                metrics=metrics,
            )
        except MalformedMessageError as error:  # a sum, or a number of the policy's
            self._count_dropped(slot, len(reward), str(error), is_useless=True)
            slot.quota_steps -= len(reward)
            slot.begin_episode()
            return
        slot.useless = 0
        slot.quota_episodes += segment.ends_episode
        self._seq += 1
        yield segment

    def _count_dropped(self, slot: _Slot, steps: int, what: str, *, is_useless: bool) -> None:
        """Count and say what is dropped; an environment that gives nothing else is broken."""
        self._tally.count("dropped_transitions", steps, reason="malformed")
        self._troubles.dropped(slot.environment.name, what, steps)
        slot.useless += is_useless
        if slot.useless >= _USELESS_IN_A_ROW:
            raise FaultyEnvironmentError(
                f"environment {slot.environment.name}: nothing that can be used in "
                f"{_USELESS_IN_A_ROW} attempts in a row, at last: {what}",
                by_mistake=True,
            )


def is_usable(obs: Array) -> bool:
    """Whether all numbers can be sent: the square of one that cannot is too large, or none."""
    flat = obs.reshape(-1)
    square = float(np.vdot(flat, flat))  # unlike dot, it does not warn of what it is to find
    return square <= MAX_PLAYED * MAX_PLAYED or bool((np.abs(flat) <= MAX_PLAYED).all())
