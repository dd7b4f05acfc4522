"""Environments: what is supported works exactly, what is not is refused in one line."""

import numpy as np
import pytest

from a2s.actors.environments.environment import Environment
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import UsageError


def _make(env_id: str) -> Environment:
    return Environment(EnvConfig(env_id=env_id))


def test_spaces_have_every_bound_of_every_dimension() -> None:
    spaces = _make("a2s_test_envs:Count-v0").spaces
    assert spaces.obs_size == 2
    assert spaces.action_low.tolist() == [-1.0, 0.5]
    assert spaces.action_high.tolist() == [3.0, 0.75]


@pytest.mark.parametrize("env_id", ["a2s_test_envs:Count-v0", "a2s_test_envs:CountFloat32-v0"])
def test_observations_are_float32_whatever_the_environment_gives(env_id: str) -> None:
    environment = _make(env_id)
    obs = environment.reset(seed=1)
    next_obs, reward, _, _ = environment.step(np.array([0.0, 0.6], dtype=np.float32))
    assert obs.dtype == next_obs.dtype == np.float32
    assert (obs.tolist(), next_obs.tolist(), reward) == ([0.0, 0.0], [0.0, 1.0], 1.0)


@pytest.mark.parametrize(
    ("env_id", "ends"),
    [
        ("a2s_test_envs:Count-v0", (True, False)),
        ("a2s_test_envs:CountTruncated-v0", (False, True)),
    ],
)
def test_an_end_is_terminated_or_truncated(env_id: str, ends: tuple[bool, bool]) -> None:
    environment = _make(env_id)
    environment.reset(seed=1)
    action = np.array([0.0, 0.6], dtype=np.float32)
    seen = [environment.step(action)[2:] for _ in range(5)]
    assert seen == [(False, False)] * 4 + [ends]


def test_the_same_seed_makes_the_same_episodes() -> None:
    first, second = _make("Hopper-v5"), _make("Hopper-v5")
    action = np.zeros(3, dtype=np.float32)
    assert np.array_equal(first.reset(seed=4), second.reset(seed=4))
    for _ in range(20):
        first.step(action)
        second.step(action)
    assert np.array_equal(first.reset(), second.reset())


@pytest.mark.parametrize(
    ("env_id", "found"),
    [
        ("NoSuchThing-v5", "NoSuchThing"),
        ("Hopper-v99", "Hopper"),
        ("Hopper-v3", "moved to the gymnasium-robotics project"),
        ("Hopper-v2", "install it, or name another"),
        ("no_such_module:Thing-v0", "no_such_module"),
        ("CartPole-v1", "Discrete"),
        ("a2s_test_envs:ImageObs-v0", "(8, 8, 3)"),
        ("a2s_test_envs:DiscreteAct-v0", "Discrete(4)"),
        ("a2s_test_envs:InfiniteAct-v0", "inf"),
        ("not an id", "not an id"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line_that_says_what_was_found(
    env_id: str, found: str
) -> None:
    with pytest.raises(UsageError) as refused:
        _make(env_id)
    assert found in str(refused.value)
    assert "\n" not in str(refused.value)
