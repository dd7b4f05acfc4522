"""Admission to a run: the facts every actor gets, and the checks of its segments."""

from dataclasses import dataclass

import numpy as np

from a2s.learner.ingest.store import Quota
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.fields import Spaces
from a2s.protocol.generations import start_of
from a2s.protocol.messages import ENDLESS_STEPS, Hello, Notice, Segment, Verdict, Welcome

_WINDOW = 64


@dataclass(frozen=True, slots=True)
class Admission:
    """Judges hellos and segments.

    ``generation`` is that of the learner, ``max_policy_lag`` is how many versions a segment
    may be behind, ``None``: any number. ``max_suggestion`` is the largest absolute value allowed.
    ``episode_limit`` is in steps, 0: the environment has none. ``short_steps`` are those of
    short episodes, 0: there are none.
    """

    run: RunConfig
    spaces: Spaces
    generation: int
    max_policy_lag: int | None
    max_suggestion: float
    episode_limit: int
    short_steps: int = 0

    @property
    def seed_before_joining(self) -> int:
        """Seed for randomness while environments are made: the same for all actors."""
        key = (self.run.seed, start_of(self.generation))
        return int(np.random.SeedSequence(key).generate_state(1)[0])

    def welcome(self, slot: int, seed: int) -> Welcome:
        """Answer a hello; ``slot`` is -1 for an actor that has only asked."""
        run = self.run
        return Welcome(
            run=run.run,
            generation=self.generation,
            env_id=run.env,
            spaces=self.spaces,
            num_envs=run.envs,
            clock=run.clock,
            slot=slot,
            seed=seed,
            env=run.env_config(),
            window=_WINDOW,
            short_steps=self.short_steps,
        )

    def difference(self, hello: Hello) -> str:
        """How the environment of a hello with spaces differs, or ``""``."""
        assert hello.spaces is not None
        if hello.env_id != self.run.env:
            return f"environment: found {hello.env_id}, expected {self.run.env}"
        difference = self.spaces.differs_from(hello.spaces)
        return f"environment {hello.env_id}: found {difference}" if difference else ""

    def is_ours(self, segment: Segment) -> bool:
        """Whether a segment was made with weights of this learner."""
        return segment.generation == self.generation

    def judge(
        self,
        segment: Segment,
        num_envs: int | None,
        newest: Notice | None,
        longest: int,
        *,
        is_flooded: bool,
    ) -> tuple[Verdict, str, str]:
        """Judge a segment that was not answered yet: verdict, kind of defect, reason.

        Its actor has ``num_envs`` environments; ``None``: it is no member. ``newest`` is of the
        newest weights, ``longest`` in steps; ``is_flooded``: more waits than can be learned from.
        """
        if not self.is_ours(segment) or num_envs is None:
            return "stale", "", self._other_generation(segment)
        if misfit := self._misfit(segment, num_envs):
            return "refused", "spaces", misfit
        if newest is None or not 1 <= segment.weights_version <= newest.version:
            return "refused", "future", f"version {segment.weights_version} is not published"
        if segment.num_steps > longest:
            found = f"found {segment.num_steps} steps, expected at most {longest}"
            return "refused", "length", f"{found}: that was the largest quota"
        if too_old := self._too_old(segment, newest):
            return "stale", "", too_old
        if self.max_policy_lag is not None and is_flooded:
            return "stale", "", "more waits than can be learned from in time"
        return "accepted", "", ""

    def _misfit(self, segment: Segment, num_envs: int) -> str:
        """Why a segment cannot be of an actor with ``num_envs`` environments, or ``""``."""
        found = (segment.obs.shape[1], segment.suggestion.shape[1])
        expected = (self.spaces.obs_size, self.spaces.action_size)
        if found != expected:
            return f"found obs_size and action_size {found}, expected {expected}"
        if segment.env >= num_envs:
            return f"found env {segment.env}, expected less than {num_envs}"
        largest = float(np.abs(segment.suggestion).max())
        if largest > self.max_suggestion:
            return f"found suggestion {largest:g}, expected at most {self.max_suggestion:g} in size"
        return ""

    def longest(self, quota: Quota) -> int:
        """The most steps that a segment may have, of those who play this quota."""
        whole = max(self.episode_limit, ENDLESS_STEPS) if quota.episodes else 0
        return max(quota.steps, whole)

    def _too_old(self, segment: Segment, newest: Notice) -> str:
        """Why a segment of this generation is stale, or ``""``."""
        if segment.epoch != newest.epoch:
            return f"epoch {segment.epoch}, this is {newest.epoch}"
        lag, allowed = newest.version - segment.weights_version, self.max_policy_lag
        if allowed is not None and lag > allowed:
            return f"{lag} versions behind, at most {allowed}"
        return ""

    def _other_generation(self, segment: Segment) -> str:
        """Whose a segment is that was made for another learner, or for an earlier start."""
        found, mine = start_of(segment.generation), start_of(self.generation)
        return f"generation {found}{f', this is {mine}' if found != mine else ' of another run'}"
