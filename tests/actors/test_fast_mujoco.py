"""The fast steps are Gymnasium's, to the bit: its own environments are the oracle."""

import os
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv

from a2s.actors.environments.environment import Environment
from a2s.actors.environments.fast_mujoco import FastSteps, fast_steps
from a2s.protocol.env_config import EnvConfig

STEPS = int(os.environ.get("FAST_STEPS", "600"))  # of each; all eleven were compared over 100,000
NAMES = (
    "Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum",
    "InvertedPendulum", "Pusher", "Reacher", "Swimmer", "Walker2d",
)  # fmt: skip
ARGUMENTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("Ant", {"include_cfrc_ext_in_observation": False, "main_body": "front_left_leg"}),
    ("Ant", {"exclude_current_positions_from_observation": False, "contact_cost_weight": 2.0}),
    ("Ant", {"terminate_when_unhealthy": False, "contact_force_range": (-0.1, 0.2)}),
    ("HalfCheetah", {"frame_skip": 2, "ctrl_cost_weight": 3.0, "max_episode_steps": 70}),
    ("HalfCheetah", {"exclude_current_positions_from_observation": False}),
    ("Hopper", {"terminate_when_unhealthy": False, "healthy_reward": 0.3}),
    ("Hopper", {"healthy_state_range": (-1.0, 1.5), "healthy_z_range": (0.1, 9.0)}),
    ("Hopper", {"exclude_current_positions_from_observation": False}),
    ("Humanoid", {"include_cinert_in_observation": False, "contact_cost_range": (0.0, 1e-6)}),
    ("Humanoid", {"include_cvel_in_observation": False, "contact_cost_weight": 1.0}),
    ("Humanoid", {"include_cfrc_ext_in_observation": False, "terminate_when_unhealthy": False}),
    ("HumanoidStandup", {"include_qfrc_actuator_in_observation": False}),
    ("HumanoidStandup", {"impact_cost_range": (0.1, 0.2), "uph_cost_weight": 2.0}),
    ("InvertedDoublePendulum", {"healthy_reward": 3.0, "max_episode_steps": 5}),
    ("Pusher", {"reward_near_weight": 2.0, "reward_control_weight": 0.3}),
    ("Reacher", {"reward_dist_weight": 2.0, "max_episode_steps": 9}),
    ("Swimmer", {"exclude_current_positions_from_observation": False}),
    ("Walker2d", {"healthy_angle_range": (-0.1, 0.1), "terminate_when_unhealthy": False}),
    ("Walker2d", {"forward_reward_weight": 2.5, "healthy_z_range": (1.2, 1.3)}),
)


def make(name: str, **arguments: Any) -> "gymnasium.Env[Any, Any]":
    return gymnasium.make(f"{name}-v5", disable_env_checker=True, **arguments)


def fast_of(env: "gymnasium.Env[Any, Any]") -> FastSteps:
    found = fast_steps(env)
    assert found is not None
    return found


@pytest.mark.parametrize(("name", "arguments"), [*((name, {}) for name in NAMES), *ARGUMENTS])
@pytest.mark.filterwarnings("ignore")  # Gymnasium's, of unusual arguments
def test_steps_equal_gymnasiums(name: str, arguments: dict[str, Any]) -> None:
    theirs, ours = make(name, **arguments), make(name, **arguments)
    fast, space = fast_of(ours), theirs.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    rng = np.random.default_rng(7)
    starts: list[Any] = [theirs.reset(seed=3)[0], ours.reset(seed=3)[0]]
    fast.begin()
    for step in range(STEPS):
        width = (1.0, 0.1, 3.0)[step // 100 % 3]  # also beyond what the motors can do
        action = (width * rng.uniform(space.low, space.high)).astype(np.float32)
        obs, reward, terminated, truncated, _ = theirs.step(action)
        found = fast.step(action)
        assert found[0].dtype == obs.dtype
        assert found[0].tobytes() == obs.tobytes(), step
        assert (float(found[1]), *found[2:4]) == (float(reward), terminated, truncated), step
        if terminated or truncated:
            starts += [theirs.reset()[0], ours.reset()[0]]
            fast.begin()
    assert all(np.array_equal(*pair) for pair in zip(starts[::2], starts[1::2], strict=True))


@pytest.mark.filterwarnings("ignore")
def test_others_are_stepped_as_they_are() -> None:
    assert fast_steps(gymnasium.make("Hopper-v4", disable_env_checker=True)) is None
    assert fast_steps(gymnasium.make("Pendulum-v1", disable_env_checker=True)) is None
    assert fast_steps(gymnasium.wrappers.ClipAction(make("Hopper"))) is None
    assert fast_steps(make("Hopper", render_mode="rgb_array")) is None

    class Own(HopperEnv):
        pass

    class OwnLimit(gymnasium.wrappers.TimeLimit):
        pass

    assert fast_steps(Own()) is None
    assert fast_steps(OwnLimit(HopperEnv(), 9)) is None
    assert fast_steps(HopperEnv()) is not None


def test_a_method_that_was_replaced_in_the_object_is_called() -> None:
    changed: Any = HopperEnv()
    changed._get_rew = lambda velocity, action: (7.0, {})
    assert fast_steps(changed) is None


@pytest.mark.parametrize("outer", [3, 9])
def test_of_two_limits_the_shorter_counts(outer: int) -> None:
    fast = fast_of(gymnasium.wrappers.TimeLimit(make("Pusher", max_episode_steps=5), outer))
    ends = [fast.step(np.zeros(7, np.float32))[3] for _ in range(5)]
    assert ends.index(True) + 1 == min(outer, 5)


def test_another_gymnasium_steps_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its formulas were compared with one version."""
    monkeypatch.setattr(gymnasium, "__version__", "1.5.0")
    assert fast_steps(make("Hopper")) is None


@pytest.mark.parametrize("repeat", [1, 3])
def test_an_environment_is_the_same_fast_or_not(repeat: int) -> None:
    """With repeated actions, a limit of its own, and observations less an offset."""
    config = EnvConfig(env_id="Hopper-v5", action_repeat=repeat, max_episode_steps=20)
    offset = np.linspace(-1, 1, 11, dtype=np.float32)
    theirs, ours = (Environment(config, offset=offset, fast=fast) for fast in (False, True))
    rng = np.random.default_rng(1)
    assert np.array_equal(theirs.reset(1), ours.reset(1))
    ends = 0
    for _ in range(100):
        action = rng.uniform(-0.2, 0.2, 3).astype(np.float32)
        found, expected = ours.step(action), theirs.step(action)
        assert found[0].tobytes() == expected[0].tobytes()
        assert found[1:] == expected[1:]
        if any(found[2:]):
            ends += 1
            assert np.array_equal(theirs.reset(), ours.reset())
    assert ends


def test_what_is_read_of_info_is_there() -> None:
    config = EnvConfig(env_id="Hopper-v5", info_metrics=("x_position",))
    environment = Environment(config, fast=True)
    environment.reset(0)
    environment.step(np.zeros(3, np.float32))
    assert [metric.name for metric in environment.metrics()] == ["x_position"]
