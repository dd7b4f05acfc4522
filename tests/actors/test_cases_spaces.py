"""Spaces: what can be used is used exactly, and what cannot is refused with its name."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from a2s_case_numbers import THIRD, UNSUPPORTED
from case_plays import action, play
from gymnasium import spaces

from a2s.actors.environments.environment import Environment
from a2s.actors.environments.faults import Faults
from a2s.actors.environments.observations import Observations
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError, UsageError

MakeGraph = Callable[..., bytes]


def _make(name: str) -> Environment:
    environment = Environment(EnvConfig(env_id=f"a2s_case_numbers:{name}-v0"))
    environment.reset(seed=1)
    return environment


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("Strict", -0.1, 0.1), ("StrictThird", -THIRD, THIRD), ("StrictSkewed", 0.1, THIRD)],
)
def test_no_action_is_outside_of_float64_bounds(
    make_graph: MakeGraph, name: str, low: float, high: float
) -> None:
    """0.1 as float32 is 0.10000000149; the environment itself refuses what is outside."""
    spaces = _make(name).spaces
    (a,), (b,) = spaces.action_low.tolist(), spaces.action_high.tolist()
    assert low <= a < b <= high
    assert np.allclose([a, b], [low, high], rtol=1e-7, atol=0)
    graph = make_graph(obs_size=3, low=(a,), high=(b,), std=2.0)
    segments = play(graph, f"a2s_case_numbers:{name}-v0", steps=1000)
    taken = {float(obs[1]) for segment in segments for obs in segment.obs}
    assert {a, b} <= taken  # as they were given, at both ends


@pytest.mark.parametrize(
    ("name", "given", "taken"),
    [
        ("Integers", [-1.0, -0.6, -0.4, 0.0, 0.4, 0.6, 1.0, 1.1], [-1, -1, 0, 0, 0, 1, 1, 1]),
        ("IntegersUnsigned", [-0.2, 0.4, 0.6, 1.4, 2.6, 3.0, 3.4], [0, 0, 1, 1, 3, 3, 3]),
    ],
)
def test_integers_are_rounded_to_the_nearest(
    name: str, given: list[float], taken: list[int]
) -> None:
    environment = _make(name)
    assert [environment.step(action(a))[0][1] for a in given] == taken


@pytest.mark.parametrize(
    ("name", "said"), [(name, said) for name, (_, said) in UNSUPPORTED.items()]
)
def test_what_cannot_be_used_is_refused_with_its_name(name: str, said: str) -> None:
    with pytest.raises(UsageError) as error:
        Environment(EnvConfig(env_id=f"a2s_case_numbers:{name}-v0"))
    words = str(error.value)
    assert re.search(f"environment .?a2s_case_numbers:{name}-v0.?: .*{said}", words), words
    assert "\n" not in words


def test_matrices_are_flat_for_us_and_matrices_for_the_environment() -> None:
    environment = _make("Matrix")
    spaces = environment.spaces
    assert spaces.obs_size == 4
    assert spaces.action_low.tolist() == [-1.0, -2.0, -3.0, -4.0]
    assert spaces.action_high.tolist() == [5.0] * 4
    obs, *_ = environment.step(action(0.5, 1.0, 2.0, 3.0))
    assert obs.tolist() == [1.0, 0.5, 2.0, 3.0]


def test_a_composite_observation_is_flat_in_the_order_of_gymnasium() -> None:
    """Keys of a Dict by the alphabet: arm, gear (one of three), velocity."""
    environment = _make("Composite")
    assert environment.spaces.obs_size == 9
    obs, *_ = environment.step(action(0.5))
    assert obs.tolist() == [7.0, 8.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.25, -0.5]


_TWO, _THREE = (spaces.Box(-1.0, 1.0, (size,)) for size in (2, 3))


@pytest.mark.parametrize(
    ("space", "obs", "size"),
    [
        (spaces.Dict({"a": _TWO, "b": _THREE}), {"a": np.zeros(3), "b": np.zeros(2)}, 5),
        (spaces.Tuple((_TWO, _THREE)), (np.zeros(3), np.zeros(2)), 5),
        (spaces.Discrete(3), np.array([0, 1]), 3),
        (spaces.MultiDiscrete([3, 3]), 2, 6),
    ],
    ids=str,
)
def test_a_part_with_another_count_of_numbers_is_a_mistake(
    space: "spaces.Space[Any]", obs: Any, size: int
) -> None:
    """Whatever the count of all of them: they would be another part's."""
    env = _make("Composite")._env
    env.unwrapped.observation_space = space
    observations = Observations(Faults("E"), env, size, 1, None)
    with pytest.raises(FaultyEnvironmentError, match="E: reset returned"):
        observations.read("reset", obs)
