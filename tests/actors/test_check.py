"""A trial refuses an environment of which nothing can be learned, as training does."""

import os
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from a2s.actors import check as check_module
from a2s.actors.check import check
from a2s.actors.environments.environment import Environment
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError


@pytest.mark.parametrize(
    ("name", "said"),
    [
        # It has been stepped ten times before: whether a seed repeats.
        ("a2s_case_numbers:BrokenFrom51-v0", "observation 1 is nan, from step 41 on"),
        ("a2s_test_envs:NanAlways-v0", "reward is nan, from step 1 on"),
    ],
)
def test_an_environment_that_gives_nothing_usable_any_more_is_refused(name: str, said: str) -> None:
    with pytest.raises(FaultyEnvironmentError) as caught:
        check(EnvConfig(env_id=name), lambda _: None)
    expected = f"environment {name}: nothing that can be used in 10 attempts in a row, at last: "
    assert str(caught.value) == expected + said


@pytest.mark.parametrize(
    ("name", "first", "unusable"),
    [
        ("a2s_case_numbers:BrokenEndTerminated-v0", "the observation of step 87", 20),
        ("a2s_test_envs:NanReward-v0", "the reward of step 3", 666),
    ],
)
def test_one_whose_steps_can_be_used_in_part_is_taken(name: str, first: str, unusable: int) -> None:
    """An episode is cut before a step that cannot, as training does."""
    found = check(EnvConfig(env_id=name), lambda _: None)
    assert (found["first_unusable"], found["unusable_steps"]) == (first, unusable)


def test_one_whose_first_observation_takes_longer_than_the_trial_is_tried_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until it has made a step, or is refused."""
    monkeypatch.setattr(check_module, "_SECONDS", 0.0)
    config = EnvConfig(env_id="a2s_case_numbers:BrokenFrom", kwargs='{"first": 0}')
    with pytest.raises(FaultyEnvironmentError, match="in 10 attempts in a row, at last: obs"):
        check_module._play(Environment(config), np.random.default_rng(0))


def test_a_mistake_is_in_the_users_file_where_packages_are_reached_by_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the home directory is one."""
    link = tmp_path / "packages"
    link.symlink_to(Path(gymnasium.__file__).resolve().parents[1])
    monkeypatch.setenv("PYTHONPATH", str(link), prepend=os.pathsep)
    with pytest.raises(FaultyEnvironmentError) as caught:
        check(EnvConfig(env_id="a2s_case_mistakes:FourValues-v0"), lambda _: None)
    said = r".*: step returned 4 values, expected 5 .* \(\S*a2s_case_envs\.py:\d+\)"
    assert re.fullmatch(said, str(caught.value))


def test_a_close_that_raises_does_not_mean_that_a_second_one_cannot_be_made() -> None:
    found = check(EnvConfig(env_id="a2s_case_processes:CloseRaises-v0"), lambda _: None)
    assert not [remark for remark in found["remarks"] if "cannot be made" in remark]
