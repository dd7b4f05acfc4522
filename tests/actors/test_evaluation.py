"""Evaluations of environments whose numbers cannot be used."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from a2s_case_envs import Control, Obs

from a2s.actors.environments.environment import Environment
from a2s.actors.evaluation import Evaluation, play
from a2s.actors.suggester import Suggester
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError

MakeGraph = Callable[..., bytes]


class BadBeginning(Control):
    """Its first observation is not a number, in every second episode that it begins."""

    begun = 0

    def reset(self, **given: Any) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode."""
        obs, info = super().reset(**given)
        self.begun += 1
        return (obs * np.nan if self.begun % 2 else obs), info


def _play(make_graph: MakeGraph, env: str, frames: int = 1, **sizes: Any) -> Evaluation:
    """Two episodes by the mean action, one after the other."""
    suggester = Suggester(make_graph(**sizes), "mean")
    config = EnvConfig(env_id=env, frame_stack=frames)
    found = play(suggester, [Environment(config)], 2, 0)
    assert found is not None
    return found


CONTROL: dict[str, Any] = {"obs_size": 3, "low": (-1.0,), "high": (1.0,)}


def test_steps_that_cannot_be_used_are_counted_and_said(
    make_graph: MakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    """One reward of each episode is NaN, 3 of 1 + 2 + 3 + 4 + 5."""
    found = _play(make_graph, "a2s_test_envs:NanReward-v0")
    assert (found.returns, found.unusable_steps) == ([12.0, 12.0], 2)
    assert "2 steps had numbers that are not finite or too large (reward is nan)" in caplog.text


def test_an_observation_that_cannot_be_used_is_in_no_later_stack(make_graph: MakeGraph) -> None:
    """Steps 97 and 194 of 200; one alone would count as ten in a row in a stack of ten."""
    sizes = {**CONTROL, "obs_size": 30}
    found = _play(make_graph, "a2s_case_numbers:Broken-v0", frames=10, **sizes)
    assert (found.lengths, found.unusable_steps) == ([100, 100], 2)


def test_an_observation_after_the_end_is_not_looked_at(make_graph: MakeGraph) -> None:
    found = _play(make_graph, "a2s_case_numbers:BrokenEndTerminated-v0", **CONTROL)
    assert (found.lengths[0], found.unusable_steps) == (97, 0)


def test_an_environment_that_gives_nothing_else_is_refused_as_in_training(
    make_graph: MakeGraph,
) -> None:
    said = r"BrokenAlways-v0: nothing that can be used in 10 attempts in a row, at last: obs"
    with pytest.raises(FaultyEnvironmentError, match=said):
        _play(make_graph, "a2s_case_numbers:BrokenAlways-v0", **CONTROL)


def test_an_episode_that_begins_with_nothing_is_begun_again(make_graph: MakeGraph) -> None:
    found = _play(make_graph, f"{Path(__file__)}:BadBeginning", **CONTROL)
    assert (found.lengths, found.unusable_steps) == ([100, 100], 0)
    assert np.isfinite(found.returns).all()


def test_environments_for_which_there_is_no_episode_do_not_play(make_graph: MakeGraph) -> None:
    """An evaluator keeps those that it has made, and a learner that goes on may want fewer."""
    suggester = Suggester(make_graph(**CONTROL), "mean")
    config = EnvConfig(env_id="a2s_case_envs:Control")
    found = play(suggester, [Environment(config, index=index) for index in range(3)], 2, 0)
    assert found is not None
    assert len(found.returns) == 2
