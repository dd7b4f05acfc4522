"""A replay that is slow and obvious, to hold the real one to; and segments to fill both."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Segment

ENV_ID = "a2s_test_envs:Count-v0"
SPACES = Spaces(
    obs_size=2,
    action_low=np.array([-1.0, 0.5], np.float32),
    action_high=np.array([3.0, 0.75], np.float32),
)


def make_segment(
    obs: list[float],
    reward: list[float],
    *,
    actor: str = "a",
    env: int = 0,
    seq: int = 0,
    end: str = "",
    before: int = 0,
) -> Segment:
    """Make a segment whose T observations are known by their first number, ``obs [T + 1]``.

    ``before`` is the number of steps of the episode before it; ``end`` is ``terminated``,
    ``truncated`` or empty.
    """
    vectors = np.array([[number, -number] for number in obs], np.float32)
    steps = len(reward)
    return Segment(
        actor=actor,
        seq=seq,
        generation=1,
        epoch=0,
        weights_version=0,
        env=env,
        obs=vectors[:-1],
        suggestion=vectors[:-1] * np.float32(0.5),
        log_prob=np.zeros(steps, np.float32),
        reward=np.array(reward, np.float32),
        final_obs=vectors[-1],
        terminated=end == "terminated",
        truncated=end == "truncated",
        episode_return=0.0,
        episode_length=before + steps,
    )


@dataclass(slots=True)
class Step:
    """One transition, and the one after it in its episode when that was inserted too."""

    obs: float
    reward: float
    next_obs: float
    terminated: bool
    following: "Step | None" = None


@dataclass(slots=True)
class Player:
    """One environment of one actor, that counts its observations so that none comes twice."""

    actor: str
    env: int
    obs: float
    length: int = 0
    latest: Step | None = None


@dataclass(slots=True)
class Oracle:
    """Every step ever inserted, in a list; of which the newest ``capacity`` count."""

    capacity: int
    steps: list[Step] = field(default_factory=list)
    players: dict[tuple[str, int], Player] = field(default_factory=dict)
    seq: int = 0

    def play(self, actor: str, env: int, num_steps: int, end: str, *, lost: bool) -> Segment:
        """Play on in an environment, and unless the segment gets lost, insert it here."""
        begin = 1000.0 * len(self.players)
        player = self.players.setdefault((actor, env), Player(actor, env, begin))
        obs = [player.obs + i for i in range(num_steps + 1)]
        reward = [0.5 * number for number in obs[:-1]]
        segment = make_segment(
            obs, reward, actor=actor, env=env, seq=self.seq, end=end, before=player.length
        )
        self.seq += 1
        player.length += num_steps
        player.obs = obs[-1]
        for i in range(num_steps):
            step = Step(obs[i], reward[i], obs[i + 1], end == "terminated" and i + 1 == num_steps)
            if player.latest is not None and not lost:
                player.latest.following = step
            player.latest = None if lost else step
            if not lost:
                self.steps.append(step)
        if end:
            player.obs += 1.0
            player.length, player.latest = 0, None
        return segment

    def live(self) -> range:
        """Numbers of the rows that can be sampled."""
        return range(max(0, len(self.steps) - self.capacity), len(self.steps))

    def target(self, row: int, n_step: int, gamma: float) -> tuple[float, float, float]:
        """Sum of discounted rewards, next observation and discount over n steps."""
        path = list(self._path(self.steps[row], n_step))
        total = sum(gamma**k * step.reward for k, step in enumerate(path))
        discount = 0.0 if path[-1].terminated else gamma ** len(path)
        return total, path[-1].next_obs, discount

    @staticmethod
    def _path(step: Step | None, n_step: int) -> Iterator[Step]:
        while step is not None and n_step > 0:
            yield step
            step, n_step = step.following, n_step - 1
