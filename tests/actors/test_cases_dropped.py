"""Numbers that cannot be used are dropped and said; wide observations travel in pieces."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from a2s_case_numbers import BROKEN
from case_plays import play

from a2s.actors.metrics import ActorMetrics, total
from a2s.protocol.codec import MAX_BYTES, encode
from a2s.protocol.errors import A2SError
from a2s.protocol.messages import Segment

MakeGraph = Callable[..., bytes]


@pytest.fixture
def graph(make_graph: MakeGraph) -> bytes:
    """A policy of the control's sizes."""
    return make_graph(obs_size=3, low=(-1.0,), high=(1.0,))


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("name", BROKEN)
def test_a_quota_is_played_until_it_has_been_sent(
    graph: bytes, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Three broken numbers in each environment, so that three pieces of the quota are missing."""
    metrics = ActorMetrics()
    segments = play(graph, f"a2s_case_numbers:{name}-v0", steps=300, metrics=metrics)
    assert [sum(s.num_steps for s in segments if s.env == env) for env in (0, 1)] == [300, 300]
    assert total(metrics.dropped) >= 6
    assert f"environment a2s_case_numbers:{name}-v0: " in caplog.text
    assert ("reward is" if "Reward" in name else "observation 1 is") in caplog.text
    assert len(caplog.messages) <= 6  # not one a step


def test_an_environment_that_gives_nothing_else_is_given_up_with_its_name(graph: bytes) -> None:
    with pytest.raises(A2SError, match=r"environment a2s_case_numbers:BrokenAlways-v0: .*nan"):
        play(graph, "a2s_case_numbers:BrokenAlways-v0", num_envs=1)


@pytest.mark.parametrize("value", ["", "Inf"])
def test_a_terminal_step_is_used_whatever_is_observed_after_it(graph: bytes, value: str) -> None:
    metrics = ActorMetrics()
    name = f"a2s_case_numbers:BrokenEndTerminated{value}-v0"
    segments = play(graph, name, steps=300, num_envs=1, metrics=metrics)
    ends = [s for s in segments if s.ends_episode]
    assert [s.episode_length for s in ends] == [97, 97, 97]
    assert all(s.terminated and s.reward[-1] == -10.0 for s in ends)
    assert all(np.isfinite(s.final_obs).all() and np.isfinite(s.obs).all() for s in segments)
    assert total(metrics.dropped) == 0


@pytest.mark.parametrize("value", ["", "Inf"])
def test_a_time_limit_needs_its_last_observation(graph: bytes, value: str) -> None:
    metrics = ActorMetrics()
    name = f"a2s_case_numbers:BrokenEndTruncated{value}-v0"
    segments = play(graph, name, steps=300, num_envs=1, metrics=metrics)
    assert total(metrics.dropped) >= 3
    assert sum(s.num_steps for s in segments) == 300
    assert all(np.isfinite(s.final_obs).all() and np.isfinite(s.obs).all() for s in segments)
    assert -10.0 not in np.concatenate([s.reward for s in segments])


@pytest.mark.parametrize(("size", "steps"), [(4096, 1100), (100_000, 60)])
def test_a_segment_is_cut_before_it_is_too_large(
    make_graph: MakeGraph, size: int, steps: int
) -> None:
    """16 MiB are 1,024 rows of 4,096 numbers, or 41 of 100,000."""
    small = {"policy_sizes": (4,), "value_sizes": (4,), "q_sizes": (4,)}
    graph = make_graph(obs_size=size, low=(-1.0,), high=(1.0,), **small)
    segments = play(graph, f"a2s_case_numbers:Wide{size}-v0", steps=steps, num_envs=1)
    assert max(len(encode(s)) for s in segments) <= MAX_BYTES[Segment]
    assert sum(s.num_steps for s in segments) == steps
    assert len(segments) >= 2
    for before, after in pairwise(segments):
        assert np.array_equal(before.final_obs, after.obs[0])
        assert after.episode_length == before.episode_length + after.num_steps
