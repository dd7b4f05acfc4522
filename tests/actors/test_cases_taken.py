"""What is taken from an environment and given to it: whatever the form, it is what happened."""

import random
from collections.abc import Callable

import numpy as np
import pytest
from a2s_case_envs import SAME_AS_CONTROL
from case_plays import action, are_the_same, play

from a2s.actors.environments.environment import Environment
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError

MakeGraph = Callable[..., bytes]
CONTROL = "a2s_case_envs:Control-v0"


@pytest.fixture
def graph(make_graph: MakeGraph) -> bytes:
    """A policy of the control's sizes."""
    return make_graph(obs_size=3, low=(-1.0,), high=(1.0,))


@pytest.mark.parametrize("name", SAME_AS_CONTROL)
def test_what_is_played_is_the_same_as_without_the_trait(graph: bytes, name: str) -> None:
    """Two episodes and a half in two environments."""
    control = play(graph, CONTROL)
    assert len(np.unique(control[0].obs, axis=0)) == 100
    assert [segment.episode_length for segment in control] == [100, 100, 100, 100, 50, 50]
    assert are_the_same(play(graph, f"a2s_case_envs:{name}-v0"), control)


@pytest.mark.parametrize("name", ["InPlace", "InPlace64", "View", "SpoiltByReset"])
def test_an_observation_is_ones_own_as_soon_as_it_is_taken(name: str) -> None:
    """Not only once a segment is made of it."""
    environment = Environment(EnvConfig(env_id=f"a2s_case_envs:{name}-v0"))
    taken = [environment.reset(seed=1)]
    taken += [environment.step(action(0.01 * i))[0] for i in range(100)]
    environment.reset()
    assert np.array_equal([obs[0] for obs in taken], np.arange(101, dtype=np.float32) / 100)
    assert not any(np.shares_memory(taken[0], obs) for obs in taken[1:])


@pytest.mark.parametrize("name", ["MutatesAction", "KeepsAction"])
def test_an_action_given_away_is_another_array(name: str) -> None:
    environment = Environment(EnvConfig(env_id=f"a2s_case_envs:{name}-v0"))
    environment.reset(seed=1)
    ours = action(0.0)
    for i in range(10):
        ours[:] = i / 10
        obs, *_ = environment.step(ours)
        assert ours[0] == obs[1] == np.float32(i / 10)


@pytest.mark.parametrize("name", ["StepRandom", "NoSeedRandom"])
def test_a_seed_repeats_what_the_modules_draw_whatever_they_drew_before(
    graph: bytes, name: str
) -> None:
    plays = []
    for before in (1, 2):
        random.seed(before)
        np.random.seed(before)  # noqa: NPY002
        plays.append(play(graph, f"a2s_case_numbers:{name}-v0"))
    assert are_the_same(*plays)
    first, second = plays[0][:2]
    assert not np.array_equal(first.obs[0], second.obs[0])  # two environments draw differently


@pytest.mark.parametrize("name", ["NoSeed", "OnlyOptions"])
def test_that_a_seed_cannot_be_given_is_said_once(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    environment = Environment(EnvConfig(env_id=f"a2s_case_envs:{name}-v0"))
    for _ in range(3):
        environment.reset(seed=1)
    said = [line for line in caplog.messages if "seed" in line]
    assert len(said) == 1, caplog.text
    assert f"environment a2s_case_envs:{name}-v0" in said[0]


@pytest.mark.parametrize(
    ("name", "said"),
    [("CloseRaises", "RuntimeError: there is nothing to close"), ("CloseExits", "SystemExit: 3")],
)
def test_a_close_that_raises_is_said_and_no_more(
    name: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    environment = Environment(EnvConfig(env_id=f"a2s_case_processes:{name}-v0"))
    environment.reset(seed=1)
    environment.close()
    assert f"environment a2s_case_processes:{name}-v0: close raised {said}" in caplog.text


def test_wrappers_repeats_and_stacks_lie_round_an_environment_in_this_order() -> None:
    """Observations plus eight, rewards times a hundred; four steps, and three of the latest."""
    config = EnvConfig(
        env_id=CONTROL,
        wrappers=(
            'a2s_case_numbers:Shift={"by": 7.0, "times": 100.0}', "a2s_case_numbers:Shift",
        ),
        action_repeat=4,
        frame_stack=3,
        max_episode_steps=10,
    )  # fmt: skip
    environment = Environment(config)
    assert environment.spaces.obs_size == 9
    first = environment.reset(seed=1)
    assert first.reshape(3, 3)[:, 1].tolist() == [8.0, 8.0, 8.0]
    steps = [environment.step(action(0.25)) for _ in range(3)]
    times = [obs.reshape(3, 3)[:, 0].tolist() for obs, *_ in steps]
    assert np.allclose(times, np.array([[0, 0, 4], [0, 4, 8], [4, 8, 10]]) / 100 + 8.0)
    assert [reward for _, reward, *_ in steps] == [-100.0, -100.0, -50.0]
    assert [truncated for *_, truncated in steps] == [False, False, True]


@pytest.mark.parametrize("name", ["Inexact", "InexactDict"])
def test_a_dtype_of_integers_rounds_no_fractions_and_rewards_of_any_kind_are_added(
    name: str,
) -> None:
    config = EnvConfig(env_id=f"a2s_case_numbers:{name}-v0", action_repeat=3, frame_stack=2)
    environment = Environment(config)
    environment.reset(seed=1)
    obs, reward, *_ = environment.step(action(0.25))
    assert np.allclose(obs, [0, 0, 1, 0.03, 0.25, np.cos(0.3)])
    assert reward == -0.75


@pytest.mark.parametrize("space", ["Discrete", "Multi"])
def test_a_class_that_there_is_none_of_is_no_other_class(space: str) -> None:
    environment = Environment(EnvConfig(env_id=f"a2s_case_numbers:NoClass{space}-v0"))
    environment.reset(seed=1)
    environment.step(action(0.25))
    with pytest.raises(FaultyEnvironmentError, match=r"step returned .*, expected .*Discrete\("):
        environment.step(action(0.25))


@pytest.mark.parametrize("frames", [1, 2])
def test_a_number_under_a_mask_is_none(frames: int) -> None:
    config = EnvConfig(env_id="a2s_case_numbers:NoClassMasked-v0", frame_stack=frames)
    environment = Environment(config)
    environment.reset(seed=1)
    steps = [environment.step(action(0.25))[0] for _ in range(2)]
    assert [bool(np.isnan(obs).any()) for obs in steps] == [False, True]


def test_an_argument_is_the_constructors_whatever_its_name() -> None:
    config = EnvConfig(
        env_id="a2s_case_numbers:Named-v0",
        kwargs='{"max_episode_steps": 50, "id": "left"}',
        max_episode_steps=9,
    )
    environment = Environment(config)
    assert vars(environment._env.unwrapped)["told"] == (50, "left")
    assert environment.episode_limit == 9


def test_seeds_are_integers_of_c(graph: bytes) -> None:
    for seed in range(5):
        play(graph, "a2s_case_numbers:Named-v0", steps=10, num_envs=8, seed=seed)


@pytest.mark.parametrize(("name", "length"), [("make_anonymously", 100), ("make_in_part", 7)])
def test_whatever_can_be_called_makes_an_environment(name: str, length: int) -> None:
    environment = Environment(EnvConfig(env_id=f"a2s_case_numbers:{name}"))
    environment.reset(seed=1)
    ends = [environment.step(action(0.25))[3] for _ in range(length)]
    assert ends.index(True) == length - 1


def test_an_observation_of_another_size_is_no_stack_of_smaller_ones() -> None:
    environment = Environment(EnvConfig(env_id="a2s_case_mistakes:Twice-v0", frame_stack=2))
    environment.reset(seed=1)
    with pytest.raises(FaultyEnvironmentError, match="of 6 numbers, expected 3"):
        environment.step(action(0.5))


def test_a_quota_of_whole_episodes_is_met_though_they_never_end(
    graph: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """As the preset of the authors asks for."""
    segments = play(graph, "a2s_case_envs:Endless-v0", steps=1, episodes=1, num_envs=1)
    assert sum(segment.num_steps for segment in segments) == 10_000
    assert segments[-1].ends_episode
    assert segments[-1].truncated
    (line,) = caplog.messages
    assert "a2s_case_envs:Endless-v0" in line
    assert "10,000 steps" in line
    assert "--max-episode-steps" in line
