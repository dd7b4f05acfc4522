"""Acting: segments are exactly what happened, and quotas are exactly what was asked for."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from a2s.actors.environments.environment import Environment
from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError
from a2s.protocol.messages import EpisodeMetric, Notice, Segment

MakeGraph = Callable[..., bytes]
MakeNotice = Callable[..., Notice]


def _rollout(
    env_id: str,
    num_envs: int,
    metrics: ActorMetrics | None = None,
    troubles: Troubles | None = None,
) -> Rollout:
    config = EnvConfig(env_id=f"a2s_test_envs:{env_id}-v0")
    environments = [Environment(config) for _ in range(num_envs)]
    return Rollout("tester", environments, 0, metrics or ActorMetrics(), troubles or Troubles())


def _never() -> bool:
    return False


def test_a_segment_is_what_happened_and_no_more(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """Episodes of 5 steps, quota 7: one whole episode, then 2 steps of the next."""
    rollout = _rollout("Count", 1)
    first, second = rollout.play(Suggester(make_graph()), make_notice(quota_steps=7), _never)
    assert first.obs.tolist() == [[0, 0], [0, 1], [0, 2], [0, 3], [0, 4]]
    assert first.reward.tolist() == [1, 2, 3, 4, 5]
    assert first.final_obs.tolist() == [0, 5]  # not [1, 0], where the next episode begins
    assert (first.terminated, first.truncated) == (True, False)
    assert (first.episode_return, first.episode_length, first.seq) == (15.0, 5, 0)
    assert second.obs.tolist() == [[1, 0], [1, 1]]
    assert second.final_obs.tolist() == [1, 2]
    assert (second.terminated, second.truncated) == (False, False)
    assert (second.episode_return, second.episode_length, second.seq) == (3.0, 2, 1)


def test_the_time_of_who_takes_a_segment_is_not_the_environments(
    make_graph: MakeGraph, make_notice: MakeNotice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock that moves only while it has one."""
    now_s = [0.0]
    monkeypatch.setattr("a2s.actors.rollout.perf_counter", lambda: now_s[0])
    metrics = ActorMetrics()
    rollout = _rollout("Count", 1, metrics)
    for _ in rollout.play(Suggester(make_graph()), make_notice(quota_steps=7), _never):
        now_s[0] += 100.0
    assert metrics.spent()["environment"] == 0.0


def test_an_episode_goes_on_under_the_next_weights(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    rollout, suggester = _rollout("Count", 1), Suggester(make_graph())
    (before,) = rollout.play(suggester, make_notice(quota_steps=3, version=3), _never)
    after, _ = rollout.play(suggester, make_notice(quota_steps=3, version=4), _never)
    assert (before.weights_version, after.weights_version) == (3, 4)
    assert after.obs.tolist() == [[0, 3], [0, 4]]
    assert (after.episode_return, after.episode_length, after.terminated) == (15.0, 5, True)


def test_a_time_limit_is_truncated(make_graph: MakeGraph, make_notice: MakeNotice) -> None:
    rollout = _rollout("CountTruncated", 1)
    segment, *_ = rollout.play(Suggester(make_graph()), make_notice(quota_steps=5), _never)
    assert (segment.terminated, segment.truncated) == (False, True)


@settings(max_examples=30, deadline=None)
@given(quota_steps=st.integers(1, 13), quota_episodes=st.integers(0, 3), num_envs=st.integers(1, 4))
def test_every_environment_plays_its_quota(
    quota_steps: int, quota_episodes: int, num_envs: int
) -> None:
    """Steps are exact; with whole episodes the last segment ends one and both are reached."""
    rollout = _rollout("Count", num_envs)
    suggester = Suggester(_GRAPH)
    notice = Notice(
        generation=1, epoch=0, version=1, quota_steps=quota_steps, quota_episodes=quota_episodes,
        num_bytes=1, sha256="",
    )  # fmt: skip
    for _ in range(2):
        segments = list(rollout.play(suggester, notice, _never))
        for env in range(num_envs):
            own = [s for s in segments if s.env == env]
            steps = sum(s.num_steps for s in own)
            if quota_episodes == 0:
                assert steps == quota_steps
            else:
                episodes = max(quota_episodes, -(-quota_steps // 5))
                assert (steps, own[-1].ends_episode) == (5 * episodes, True)
    assert rollout.segments_made == segments[-1].seq + 1


def test_an_interruption_yields_what_was_played(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    asked = iter([False, False, True])
    rollout = _rollout("Count", 2)
    segments = list(
        rollout.play(Suggester(make_graph()), make_notice(quota_steps=100), lambda: next(asked))
    )
    assert [(s.env, s.num_steps) for s in segments] == [(0, 2), (1, 2)]


def test_the_same_seed_plays_the_same(make_graph: MakeGraph, make_notice: MakeNotice) -> None:
    graph = make_graph(obs_size=11, low=(-1.0,) * 3, high=(1.0,) * 3)

    def play() -> list[Segment]:
        environments = [Environment(EnvConfig(env_id="Hopper-v5")) for _ in range(3)]
        rollout = Rollout("tester", environments, 7, ActorMetrics(), Troubles())
        return list(rollout.play(Suggester(graph), make_notice(quota_steps=60), _never))

    for one, other in zip(play(), play(), strict=True):
        assert np.array_equal(one.obs, other.obs)
        assert np.array_equal(one.suggestion, other.suggestion)
    assert not np.array_equal(play()[0].obs[0], play()[1].obs[0])


def test_a_step_with_a_reward_that_is_no_number_is_dropped_counted_and_made_up_for(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """The third reward of each episode is none: episodes are cut before it, and the quota met."""
    metrics, troubles = ActorMetrics(), Troubles()
    rollout = _rollout("NanReward", 1, metrics, troubles)
    segments = list(rollout.play(Suggester(make_graph()), make_notice(quota_steps=7), _never))
    assert [s.obs.tolist() for s in segments] == [
        [[0, 0], [0, 1]], [[1, 0], [1, 1]], [[2, 0], [2, 1]], [[3, 0]],
    ]  # fmt: skip
    assert [s.final_obs.tolist() for s in segments[:3]] == [[0, 2], [1, 2], [2, 2]]
    assert [s.truncated for s in segments] == [True, True, True, False]
    assert [s.episode_return for s in segments] == [3.0, 3.0, 3.0, 1.0]
    assert total(metrics.dropped) == total(metrics.dropped.labels("malformed")) == 3
    assert troubles.dropped_steps == 3
    assert troubles.latest == (
        "environment a2s_test_envs:NanReward-v0: reward is nan, 3 transitions dropped"
    )


def test_an_environment_that_gives_nothing_usable_is_given_up_with_the_reason(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    rollout = _rollout("NanAlways", 1)
    with pytest.raises(FaultyEnvironmentError, match=r"10 attempts in a row.*reward is nan"):
        list(rollout.play(Suggester(make_graph()), make_notice(quota_steps=7), _never))
    assert rollout.segments_made == 0


def test_a_batch_of_whole_episodes_is_met_by_those_that_had_to_be_cut(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    notice = make_notice(quota_steps=1, quota_episodes=2)
    segments = list(_rollout("NanFirst", 1).play(Suggester(make_graph()), notice, _never))
    assert [(s.num_steps, s.terminated, s.truncated) for s in segments] == [
        (2, False, True),
        (5, True, False),
    ]


def test_what_is_refused_at_the_end_of_a_quota_is_played_again(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """An episode pays 1e9, 2e9, 3e9...: the return of its first six steps is more than 1e10."""
    rollout, suggester = _rollout("PaysMost", 1), Suggester(make_graph())
    for _ in range(4):
        segments = list(rollout.play(suggester, make_notice(quota_steps=3), _never))
        assert [(s.num_steps, s.episode_return) for s in segments] == [(3, 6e9)]


def test_the_metrics_of_a_dropped_step_are_not_those_of_the_episode(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    segments = list(
        _rollout("TellsNan", 1).play(Suggester(make_graph()), make_notice(quota_steps=7), _never)
    )
    assert [(s.num_steps, s.metrics) for s in segments][:2] == [(2, ()), (2, ())]
    told = list(
        _rollout("Tells", 1).play(Suggester(make_graph()), make_notice(quota_steps=7), _never)
    )
    assert [s.metrics for s in told] == [(EpisodeMetric(name="is_success", value=5.0),), ()]


@pytest.fixture(autouse=True)
def _graph(make_graph: MakeGraph) -> None:
    global _GRAPH
    _GRAPH = make_graph()


_GRAPH = b""
