"""Fresh episodes with a policy that no longer changes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from a2s.actors.environment import Environment
from a2s.actors.suggester import Mode, Suggester
from a2s.protocol.errors import MalformedMessageError, UsageError

# Keeps the seeds of evaluation apart from those of training.
_EVALUATION = 0xE7A1


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """What a policy reached.

    Attributes:
        returns: Undiscounted return of each episode.
        lengths: Steps of each episode.
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over the episodes."""
        return float(np.std(self.returns))


def read_policy(path: Path, mode: Mode) -> Suggester:
    """Load a policy file.

    Raises:
        UsageError: There is no such file, or it is not a policy.
    """
    try:
        return Suggester(path.read_bytes(), mode)
    except OSError as error:
        raise UsageError(f"policy {path}: {error.strerror}") from None
    except MalformedMessageError as error:
        raise UsageError(f"policy {path}: {error}") from None


def evaluate(policy: Suggester, env_id: str, episodes: int, seed: int) -> Evaluation:
    """Play episodes side by side, each from a seed of its own.

    Args:
        policy: How to act.
        env_id: Where.
        episodes: How many.
        seed: Makes the same episodes again; never those of training.

    Raises:
        UsageError: The environment cannot be made, or does not fit the policy.
    """
    *env_seeds, noise_seed = np.random.SeedSequence([_EVALUATION, seed]).generate_state(
        episodes + 1
    )
    rng = np.random.default_rng(noise_seed)
    environments = [Environment(env_id) for _ in range(episodes)]
    policy.check(environments[0].spaces, env_id)
    obs = [env.reset(int(s)) for env, s in zip(environments, env_seeds, strict=True)]
    returns, lengths = [0.0] * episodes, [0] * episodes
    playing = list(range(episodes))
    while playing:
        action = policy(np.stack([obs[i] for i in playing]), rng).action
        ended = set()
        for row, i in enumerate(playing):
            obs[i], reward, terminated, truncated = environments[i].step(action[row])
            returns[i] += reward
            lengths[i] += 1
            if terminated or truncated:
                ended.add(i)
        playing = [i for i in playing if i not in ended]
    for environment in environments:
        environment.close()
    return Evaluation(returns=tuple(returns), lengths=tuple(lengths))
