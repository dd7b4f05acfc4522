"""Short episodes: half of the steps, at beginnings of episodes, without returns of their own."""

from collections.abc import Callable

from a2s.actors.environments.environment import Environment
from a2s.actors.metrics import ActorMetrics, total
from a2s.actors.rollout import Rollout
from a2s.actors.suggester import Suggester
from a2s.actors.troubles import Troubles
from a2s.learner.feed import Arrival
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.messages import Notice, Segment

MakeGraph = Callable[..., bytes]
MakeNotice = Callable[..., Notice]


def _rollout(env_id: str, short_steps: int, metrics: ActorMetrics) -> Rollout:
    environment = Environment(EnvConfig(env_id=f"a2s_test_envs:{env_id}-v0"))
    rollout = Rollout("tester", [environment], 0, metrics, Troubles())
    rollout.short_steps = short_steps
    return rollout


def _play(short_steps: int, graph: bytes, notice: Notice, metrics: ActorMetrics) -> list[Segment]:
    """Episodes that end by themselves after 5 steps."""
    rollout = _rollout("Count", short_steps, metrics)
    return list(rollout.play(Suggester(graph), notice, lambda: False))


def test_as_many_steps_are_made_in_short_episodes_as_in_the_whole_one_before(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """5 steps, then 2 + 2 + 2 of episodes of which nobody knows the end, then 5 again."""
    metrics = ActorMetrics()
    played = _play(2, make_graph(), make_notice(quota_steps=13), metrics)
    assert [(s.short, s.num_steps) for s in played] == [
        (False, 5), (True, 2), (True, 2), (True, 2), (False, 2)
    ]  # fmt: skip
    assert [(s.terminated, s.truncated) for s in played] == [(True, False)] + 4 * [(False, False)]
    assert [s.obs[0].tolist() for s in played] == [[0, 0], [1, 0], [2, 0], [3, 0], [4, 0]]
    assert [s.final_obs.tolist() for s in played] == [[0, 5], [1, 2], [2, 2], [3, 2], [4, 2]]
    assert [s.episode_length for s in played] == [5, 2, 2, 2, 2]
    assert total(metrics.episodes) == 1


def test_a_short_episode_that_ends_by_itself_has_ended_and_its_return_is_nobodys(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """After 5 steps of a whole one 1, then 4, by quotas of 3 steps; every second one falls."""
    metrics = ActorMetrics()
    rollout = _rollout("Falls", 4, metrics)
    suggester, notice = Suggester(make_graph()), make_notice(quota_steps=3)
    played = [s for _ in range(4) for s in rollout.play(suggester, notice, lambda: False)]
    assert [(s.short, s.num_steps, s.episode_length, s.terminated) for s in played] == [
        (False, 3, 3, False), (False, 2, 5, True), (True, 1, 1, True), (True, 3, 3, False),
        (True, 1, 4, False), (False, 1, 1, True), (False, 1, 1, False),
    ]  # fmt: skip
    assert total(metrics.episodes) == 2
    counted = [s.episode_return for s in played if Arrival.of(s, 0).episode is not None]
    assert counted == [15.0, 1.0]


def test_a_short_episode_that_has_to_be_cut_counts_with_the_steps_that_are_left(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """After 5 steps of a whole one 2 + 2 + 2 in short ones of 4, then a whole one again."""
    rollout, notice = _rollout("Breaks", 4, ActorMetrics()), make_notice(quota_steps=13)
    played = list(rollout.play(Suggester(make_graph()), notice, lambda: False))
    assert [(s.short, s.num_steps, s.truncated) for s in played] == [
        (False, 5, False), (True, 2, True), (True, 2, True), (True, 2, True), (False, 2, False)
    ]  # fmt: skip


def test_a_learner_that_wants_none_has_the_short_one_left(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    """After 5 steps of a whole one and 1 of a short one."""
    rollout = _rollout("Count", 2, ActorMetrics())
    suggester, notice = Suggester(make_graph()), make_notice(quota_steps=6)
    before = list(rollout.play(suggester, notice, lambda: False))
    rollout.short_steps = 0
    after = list(rollout.play(suggester, notice, lambda: False))
    assert [(s.short, s.num_steps) for s in before + after] == [
        (False, 5), (True, 1), (True, 1), (False, 5)
    ]  # fmt: skip


def test_whole_episodes_that_are_no_longer_are_all_there_are(
    make_graph: MakeGraph, make_notice: MakeNotice
) -> None:
    metrics = ActorMetrics()
    for short_steps in (0, 5, 9):
        played = _play(short_steps, make_graph(), make_notice(quota_steps=20), metrics)
        assert [(s.short, s.num_steps) for s in played] == 4 * [(False, 5)]
