"""Acting: several environments, one batched call for all of them, segments out."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from time import perf_counter

import numpy as np

from a2s.actors.environments.environment import Environment
from a2s.actors.environments.making import MAX_SEED, seed_globals
from a2s.actors.metrics import ActorMetrics
from a2s.actors.suggester import Choice, Suggester
from a2s.actors.troubles import Troubles
from a2s.protocol.codec import MAX_BYTES, MIB
from a2s.protocol.errors import FaultyEnvironmentError, MalformedMessageError
from a2s.protocol.fields import Array, is_within
from a2s.protocol.messages import ENDLESS_STEPS, MAX_PLAYED, EpisodeMetric, Notice, Segment

MAX_USELESS_IN_A_ROW = 10
_SEGMENT_BYTES = MAX_BYTES[Segment] - MIB  # the rest is for all but the rows
_FLOAT_BYTES = 4
_NOTHING: Iterator[Segment] = iter(())


class _Slot:
    """One environment and the steps of its segment so far."""

    def __init__(self, index: int, environment: Environment, seed: int) -> None:
        self.index, self.environment = index, environment
        self.useless = 0
        self.owed_steps = 0  # in short episodes
        self.begin_quota()
        self.begin_segment()
        self.begin_episode(seed)

    def begin_quota(self) -> None:
        self.quota_steps = self.quota_episodes = 0

    def begin_segment(self) -> None:
        self.rows: list[tuple[Array, Array, float, float]] = []

    def begin_episode(self, seed: int | None = None) -> None:
        self.obs = self.environment.reset(seed)
        self.episode_return = 0.0
        self.episode_length = 0
        self.is_short = self.owed_steps > 0

    def has_met(self, notice: Notice) -> bool:
        """Whether its quota has been played."""
        if self.quota_steps < notice.quota_steps:
            return False
        if notice.quota_episodes == 0:
            return True
        return self.quota_episodes >= notice.quota_episodes and self.episode_length == 0

    def begin_another(self, short_steps: int) -> None:
        """Begin the episode after this one: a short one while steps in such are owed.

        As many are owed as a whole one has taken that had more than ``short_steps``.
        """
        if short_steps == 0:
            self.owed_steps = 0
        elif self.is_short:
            self.owed_steps -= self.episode_length
        elif short_steps < self.episode_length:
            self.owed_steps = self.episode_length
        self.begin_episode()

    def is_endless(self) -> bool:
        """Whether nothing has ended the episode, or ever will."""
        return self.environment.episode_limit is None and self.episode_length >= ENDLESS_STEPS


class Rollout:
    """Plays B environments, at least one, with the given weights; it resets them itself.

    A step with unusable numbers is dropped and the episode cut before it. Dropped steps are played
    again, so that the quota is always delivered. ``actor`` is the name to send under; ``seed`` is
    for the environments, ``random``, ``np.random`` and the suggestions' noise.

    Attributes:
        segments_made: Segments that were yielded.
        short_steps: After a whole episode of more steps as many are made in episodes of at most so
            many (docs/adr/0038); 0: never.
    """

    def __init__(
        self,
        actor: str,
        environments: Sequence[Environment],
        seed: int,
        metrics: ActorMetrics,
        troubles: Troubles,
    ) -> None:
        drawn = np.random.SeedSequence(seed).generate_state(len(environments) + 1)
        *env_seeds, noise_seed = (int(number) for number in drawn & MAX_SEED)
        seed_globals(noise_seed)
        self._actor = actor
        self._slots = [
            _Slot(index, *pair)
            for index, pair in enumerate(zip(environments, env_seeds, strict=True))
        ]
        self._rng = np.random.default_rng(noise_seed)
        self._metrics, self._troubles = metrics, troubles
        self.short_steps = 0
        self._environment_s = metrics.seconds.labels("environment")
        self._selection_s = metrics.seconds.labels("selection")
        self._choice: Choice | None = None
        metrics.q_spread.set_function(self._q_spread)
        self.segments_made = 0
        spaces = environments[0].spaces
        row_bytes = _FLOAT_BYTES * (spaces.obs_size + spaces.action_size + 2)
        room = _SEGMENT_BYTES - _FLOAT_BYTES * spaces.obs_size  # for the last observation
        self._max_rows = max(1, room // row_bytes)

    def play(
        self, suggester: Suggester, notice: Notice, interrupted: Callable[[], bool]
    ) -> Iterator[Segment]:
        """Play the quota of one version in every environment; yield segments once complete.

        Every environment makes ``quota_steps`` steps that can be sent; with ``quota_episodes`` it
        goes on to the end of the episode in which both are reached. Episodes go on across calls.
        ``interrupted`` is called before every step; when true, the steps played so far are yielded.

        Raises:
            FaultyEnvironmentError: An environment raised, or gives only unusable values.
        """
        playing = self._slots
        for slot in self._slots:
            slot.begin_quota()
        while playing and not interrupted():
            obs = np.array([slot.obs for slot in playing])
            if not is_usable(obs):
                yield from self._drop_unusable(playing, notice)
                continue
            yield from self._round(playing, self._choose(suggester, obs), notice)
            met = [slot for slot in playing if slot.has_met(notice)]
            for slot in met:
                yield from self._finish_quota(slot, notice)
            if met:
                playing = [slot for slot in playing if not slot.has_met(notice)]
        yield from self._drop_unusable(self._slots, notice)
        for slot in self._slots:
            yield from self._cut(slot, notice)

    def _round(self, playing: Sequence[_Slot], choice: Choice, notice: Notice) -> Iterator[Segment]:
        """Make a step in every environment; what its receiver does with a segment is not timed."""
        begin, away_s = perf_counter(), 0.0
        for row, slot in enumerate(playing):
            for segment in self._step(slot, choice, row, notice):
                left = perf_counter()
                yield segment
                away_s += perf_counter() - left
        spent = perf_counter() - begin - away_s
        self._environment_s.inc(spent)
        self._metrics.env_steps.inc(len(playing))
        self._metrics.env_step_seconds.observe(spent / len(playing))

    def _finish_quota(self, slot: _Slot, notice: Notice) -> Iterator[Segment]:
        """Send the rest of a quota that is met; steps that prove unusable must be played again."""
        yield from self._drop_unusable([slot], notice)
        if slot.has_met(notice):
            yield from self._cut(slot, notice)

    def _choose(self, suggester: Suggester, obs: Array) -> Choice:
        begin = perf_counter()
        self._choice = choice = suggester(obs, self._rng)
        spent = perf_counter() - begin
        self._selection_s.inc(spent)
        self._metrics.select_seconds.observe(spent)
        return choice

    def _q_spread(self) -> float:
        return math.nan if self._choice is None else float(self._choice.q_spread.mean())

    def _step(self, slot: _Slot, choice: Choice, row: int, notice: Notice) -> Iterator[Segment]:
        """Make a step in one environment; gives the segments that end with it."""
        obs, reward, terminated, truncated = slot.environment.step(choice.action[row])
        if wrong := wrong_reward(reward):
            return self._abandon(slot, notice, wrong, 1)
        slot.rows.append((slot.obs, choice.suggestion[row], choice.log_prob[row], reward))
        slot.episode_return += reward
        slot.episode_length += 1
        slot.quota_steps += 1
        if terminated and not is_usable(obs):
            obs = slot.obs  # not used: the value of a terminal state is 0
        slot.obs = obs
        if terminated or truncated:
            return self._end(slot, notice, terminated=terminated, truncated=truncated)
        if notice.quota_episodes and slot.is_endless():
            self._troubles.cut(slot.environment.name, slot.episode_length)
            return self._end(slot, notice, terminated=False, truncated=True)
        if slot.is_short and slot.episode_length >= self.short_steps and is_usable(obs):
            return self._leave(slot, notice)
        if len(slot.rows) >= self._max_rows and is_usable(obs):
            return self._cut(slot, notice)
        return _NOTHING

    def _end(
        self, slot: _Slot, notice: Notice, *, terminated: bool, truncated: bool
    ) -> Iterator[Segment]:
        """End the episode with its latest step."""
        if not is_usable(slot.obs):
            yield from self._drop_unusable([slot], notice)
            return
        self._count_episode(slot, terminated=terminated)
        told = slot.environment.metrics()
        yield from self._cut(slot, notice, terminated=terminated, truncated=truncated, told=told)
        slot.begin_another(self.short_steps)

    def _leave(self, slot: _Slot, notice: Notice) -> Iterator[Segment]:
        """Leave a short episode, which goes on for who learns from it."""
        yield from self._cut(slot, notice)
        slot.begin_another(self.short_steps)

    def _drop_unusable(self, slots: Iterable[_Slot], notice: Notice) -> Iterator[Segment]:
        """Drop the latest step of environments whose observation cannot be used."""
        for slot in slots:
            obs, is_step = slot.obs, bool(slot.rows)
            if is_usable(obs):
                continue
            if is_step:
                slot.obs, _, _, reward = slot.rows.pop()
                slot.episode_return -= reward
                slot.episode_length -= 1
                slot.quota_steps -= 1
            yield from self._abandon(slot, notice, wrong_in(obs), int(is_step))

    def _abandon(self, slot: _Slot, notice: Notice, what: str, steps: int) -> Iterator[Segment]:
        """Cut the episode after the steps that can be used, and begin another."""
        self._count_dropped(slot, steps, what, is_useless=not slot.rows)
        if slot.rows:
            self._count_episode(slot, terminated=False)
        yield from self._cut(slot, notice, truncated=True)
        slot.begin_another(self.short_steps)

    def _cut(
        self, slot: _Slot, notice: Notice, *, terminated: bool = False, truncated: bool = False,
        told: tuple[EpisodeMetric, ...] = (),
    ) -> Iterator[Segment]:  # fmt: skip
        """Make a segment of the steps so far, if there are any."""
        if not slot.rows:
            return
        obs, suggestion, log_prob, reward = zip(*slot.rows, strict=True)
        slot.begin_segment()
        try:
            segment = Segment(
                actor=self._actor,
                seq=self.segments_made,
                generation=notice.generation,
                epoch=notice.epoch,
                weights_version=notice.version,
                env=slot.index,
                obs=np.array(obs),
                suggestion=np.array(suggestion),
                log_prob=np.array(log_prob, dtype=np.float32),
                reward=np.array(reward, dtype=np.float32),
                final_obs=slot.obs,
                terminated=terminated,
                truncated=truncated,
                episode_return=slot.episode_return,
                episode_length=slot.episode_length,
                metrics=told,
                short=slot.is_short,
            )
        except MalformedMessageError as error:  # a sum, or a number of the policy's
            self._count_dropped(slot, len(reward), str(error), is_useless=True)
            slot.quota_steps -= len(reward)
            slot.begin_episode()
            return
        slot.useless = 0
        slot.quota_episodes += segment.ends_episode
        self.segments_made += 1
        yield segment

    def _count_episode(self, slot: _Slot, *, terminated: bool) -> None:
        if slot.is_short:
            return
        self._metrics.episodes.labels("terminated" if terminated else "truncated").inc()
        self._metrics.episode_return_last.set(slot.episode_return)
        self._metrics.episode_length.observe(slot.episode_length)

    def _count_dropped(self, slot: _Slot, steps: int, what: str, *, is_useless: bool) -> None:
        """Count and report dropped steps; an environment that gives nothing else is broken."""
        self._metrics.dropped.labels("malformed").inc(steps)
        self._troubles.dropped(slot.environment.name, what, steps)
        slot.useless += is_useless
        if slot.useless >= MAX_USELESS_IN_A_ROW:
            raise useless(slot.environment.name, what)


def is_usable(obs: Array) -> bool:
    """Whether all numbers can be sent."""
    return is_within(obs, MAX_PLAYED)


def wrong_in(obs: Array) -> str:
    """Name the first number of an observation that is not usable."""
    bad = int(np.flatnonzero(~(np.abs(obs) <= MAX_PLAYED))[0])
    return f"observation {bad} is {obs[bad]:g}"


def wrong_reward(reward: float) -> str:
    """Name a reward that cannot be sent; empty: it can."""
    is_usable = -MAX_PLAYED <= reward <= MAX_PLAYED  # false for NaN as well
    return "" if is_usable else f"reward is {reward:g}"


def useless(environment: str, what: str) -> FaultyEnvironmentError:
    """Make the error of an environment that gives nothing usable."""
    return FaultyEnvironmentError(
        f"environment {environment}: nothing that can be used in {MAX_USELESS_IN_A_ROW} attempts "
        f"in a row, at last: {what}",
        by_mistake=True,
    )
