"""What messages demand of themselves, whoever makes them."""

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.fields import MAX_METRICS, Array, Spaces, is_name
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    EpisodeMetric,
    Hello,
    Notice,
    Segment,
)


def zeros(*shape: int) -> Array:
    """Make float32 zeros."""
    return np.zeros(shape, np.float32)


def make_spaces(**changes: Any) -> Spaces:
    """Make the spaces of D = 3, A = 2."""
    values: dict[str, Any] = {"obs_size": 3, "action_low": -1 - zeros(2), "action_high": zeros(2)}
    return Spaces(**values | changes)


def make_hello(**changes: Any) -> Hello:
    """Make a joining hello."""
    values: dict[str, Any] = {"actor": "h-1", "num_envs": 2, "env_id": "E", "spaces": make_spaces()}
    return Hello(**values | changes)


def make_segment(**changes: Any) -> Segment:
    """Make a segment of T = 4, D = 3, A = 2."""
    values: dict[str, Any] = {
        "actor": "h-1",
        "seq": 7,
        "generation": 1,
        "epoch": 0,
        "weights_version": 2,
        "env": 0,
        "obs": zeros(4, 3),
        "suggestion": zeros(4, 2),
        "log_prob": zeros(4),
        "reward": zeros(4),
        "final_obs": zeros(3),
        "terminated": False,
        "truncated": False,
        "episode_return": 0.0,
        "episode_length": 4,
    }
    return Segment(**values | changes)


def make_notice(**changes: Any) -> Notice:
    """Make a notice."""
    values: dict[str, Any] = {
        "generation": 3,
        "epoch": 0,
        "version": 8,
        "quota_steps": 100,
        "quota_episodes": 0,
        "num_bytes": 1,
        "sha256": "00",
    }
    return Notice(**values | changes)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"obs_size": 0}, "spaces: obs_size: found 0, expected at least 1"),
        ({"obs_size": -3}, "spaces: obs_size: found -3, expected at least 1"),
        ({"action_low": zeros(0)}, "spaces: action_low: found (0,), expected shape [A]"),
        ({"action_low": zeros(2, 1)}, "spaces: action_low: found (2, 1), expected shape [A]"),
        ({"action_high": zeros(3)}, "spaces: action_high: found (3,), expected (2,)"),
        (
            {"action_high": zeros(2) + np.inf},
            "spaces: action_high: found 2 non-finite values, expected finite numbers",
        ),
        (
            {"action_low": zeros(2)},  # as high as action_high
            "spaces: found low >= high, expected low below high everywhere",
        ),
        ({"obs_offset": zeros(2)}, "spaces: obs_offset: found (2,), expected (3,)"),
        ({"obs_offset": zeros(3, 1)}, "spaces: obs_offset: found (3, 1), expected (3,)"),
        (
            {"obs_offset": zeros(3) + np.nan},
            "spaces: obs_offset: found 3 non-finite values, expected finite numbers",
        ),
        (
            {"obs_offset": np.array([0, np.inf, -np.inf], np.float32)},
            "spaces: obs_offset: found 2 non-finite values, expected finite numbers",
        ),
    ],
)
def test_impossible_spaces_are_refused(changes: dict[str, Any], reason: str) -> None:
    """An action must have somewhere to go in every dimension."""
    with pytest.raises(MalformedMessageError) as caught:
        make_spaces(**changes)
    assert str(caught.value) == reason


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({}, ""),
        ({"obs_size": 4}, "obs_size 4, expected 3"),
        (
            {"action_low": -1 - zeros(1), "action_high": zeros(1)},
            "action_size 1, expected 2",
        ),
        ({"action_low": zeros(2) - 2}, "action_low [-2.0, -2.0], expected [-1.0, -1.0]"),
        ({"action_high": zeros(2) + 2}, "action_high [2.0, 2.0], expected [0.0, 0.0]"),
        ({"obs_offset": zeros(3) + 1}, ""),  # the learner's choice
    ],
)
def test_the_difference_of_spaces_says_what_the_other_has(
    changes: dict[str, Any], difference: str
) -> None:
    """A refused actor reads it."""
    assert make_spaces().differs_from(make_spaces(**changes)) == difference


def test_a_hello_asks_or_joins() -> None:
    """Asking says nothing, joining says everything."""
    assert make_hello().spaces is not None
    assert make_hello(num_envs=0, env_id="", spaces=None).spaces is None


@pytest.mark.parametrize(
    ("changes", "subject"),
    [
        ({"actor": ""}, "hello: actor"),
        ({"actor": "a/b"}, "hello: actor"),
        ({"actor": "*"}, "hello: actor"),
        ({"actor": "a" * 97}, "hello: actor"),
        ({"env_id": ""}, "hello: env_id"),
        ({"spaces": None}, "hello: env_id"),
        ({"num_envs": 0}, "hello: num_envs"),
        ({"num_envs": -1}, "hello: num_envs"),
        ({"num_envs": 4097}, "hello: num_envs"),
        ({"spaces": None, "env_id": ""}, "hello: num_envs"),
    ],
)
def test_a_hello_that_does_neither_is_refused(changes: dict[str, Any], subject: str) -> None:
    """Half of a joining hello would make half of a member."""
    with pytest.raises(MalformedMessageError, match=f"^{subject}: found "):
        make_hello(**changes)


@pytest.mark.parametrize(
    ("terminated", "truncated", "ends"),
    [(False, False, False), (True, False, True), (False, True, True)],
)
def test_a_segment_knows_its_length_and_whether_the_episode_ended(
    terminated: bool, truncated: bool, ends: bool
) -> None:
    """Either end is an end."""
    segment = make_segment(terminated=terminated, truncated=truncated)
    assert (segment.num_steps, segment.ends_episode) == (4, ends)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"obs": zeros(12)}, "found (12,), expected obs [T, D]"),
        ({"obs": zeros(0, 3)}, "found (0, 3), expected obs [T, D]"),
        ({"suggestion": zeros(4)}, "found (4,), expected suggestion [T, A]"),
        ({"obs": zeros(5, 3)}, "arrays disagree about T"),
        ({"suggestion": zeros(3, 2)}, "arrays disagree about T"),
        ({"log_prob": zeros(4, 1)}, "arrays disagree about T"),
        ({"reward": zeros(5)}, "arrays disagree about T"),
        ({"reward": zeros()}, "arrays disagree about T"),
        ({"final_obs": zeros(2)}, "final_obs: found (2,), expected (3,) as in obs"),
        ({"final_obs": zeros(1, 3)}, "final_obs: found (1, 3), expected (3,) as in obs"),
        ({"terminated": True, "truncated": True}, "found both ends, expected one of them"),
        ({"seq": -1}, "seq: found -1, expected >= 0"),
        ({"generation": -1}, "generation: found -1, expected >= 0"),
        ({"epoch": -1}, "epoch: found -1, expected >= 0"),
        ({"weights_version": -1}, "weights_version: found -1, expected >= 0"),
        ({"env": -1}, "env: found -1, expected >= 0"),
        ({"episode_length": 3}, "found 3, expected episode_length >= T"),
        ({"episode_return": float("nan")}, "episode_return: found nan, expected at most 1e+10"),
        ({"episode_return": -2e10}, "episode_return: found 20000000000.0, expected at most 1e+10"),
        ({"obs": zeros(4, 3) + np.nan}, "obs: found nan, expected at most 1e+10 in size"),
        ({"obs": zeros(4, 3) - 2e10}, "obs: found 20000000000.0, expected at most 1e+10"),
        ({"suggestion": zeros(4, 2) + np.inf}, "suggestion: found inf, expected at most 1e+06"),
        ({"suggestion": zeros(4, 2) - 2e6}, "suggestion: found 2000000.0, expected at most 1e+06"),
        ({"log_prob": zeros(4) - np.inf}, "log_prob: found inf, expected at most 1e+06"),
        ({"log_prob": zeros(4) + 2e6}, "log_prob: found 2000000.0, expected at most 1e+06"),
        ({"reward": zeros(4) + np.nan}, "reward: found nan, expected at most 1e+10"),
        ({"reward": zeros(4) + 2e10}, "reward: found 20000000000.0, expected at most 1e+10"),
        ({"final_obs": zeros(3) + np.nan}, "final_obs: found nan, expected at most 1e+10"),
        ({"final_obs": zeros(3) + 2e10}, "final_obs: found 20000000000.0, expected at most 1e+10"),
    ],
)
def test_a_segment_that_contradicts_itself_is_refused_at_the_sender(
    changes: dict[str, Any], reason: str
) -> None:
    """The reason names the actor and the segment."""
    with pytest.raises(MalformedMessageError) as caught:
        make_segment(**changes)
    number = changes.get("seq", 7)
    assert str(caught.value).startswith(f"segment h-1/{number}: ")
    assert reason in str(caught.value)


def test_a_segment_of_a_nameless_actor_is_refused() -> None:
    """Nobody could be told about it."""
    with pytest.raises(MalformedMessageError, match=r"^segment: actor: found 'a/b', expected"):
        make_segment(actor="a/b")


@pytest.mark.parametrize("actor", ["", "a/b", "x\n" * 100_000])
def test_a_status_of_a_nameless_actor_is_refused(actor: str) -> None:
    """The learner shows the names of those who have not joined yet."""
    with pytest.raises(MalformedMessageError, match=r"^actor status: actor: found '"):
        ActorStatus(
            actor=actor,
            slot=-1,
            weights_version=0,
            epoch=0,
            env_steps=0,
            episodes=0,
            segments_sent=0,
            segments_answered=0,
            spooled_steps=0,
            leaving=False,
        )


def test_a_segment_has_a_bounded_number_of_metrics() -> None:
    """Each is a column of a table and a gauge."""
    metrics = tuple(EpisodeMetric(name=f"m{i}", value=1.0) for i in range(MAX_METRICS + 1))
    assert make_segment(metrics=metrics[1:], terminated=True).metrics == metrics[1:]
    with pytest.raises(MalformedMessageError) as caught:
        make_segment(metrics=metrics, terminated=True)
    assert str(caught.value) == "segment h-1/7: metrics: found 33, expected at most 32"


@pytest.mark.parametrize(
    "name", ["is_success", "a", "dist to goal, m", 'é/"ü"', "路", "x" * 96, " "]
)
@pytest.mark.parametrize("value", [0.0, -1e300])
def test_a_metric_has_a_name_that_can_be_shown(name: str, value: float) -> None:
    """Commas and quotes are written as CSV and Prometheus write them."""
    assert EpisodeMetric(name=name, value=value).name == name


@pytest.mark.parametrize(
    "name",
    ["", "x" * 97, "a\nb", "a\r", "\t", "a\0", "\x1b[31m", "\x7f", "a\u2028b", "\u202e", "\ud800",
     "x\n" * 400_000],
)  # fmt: skip
def test_a_metric_with_another_name_is_refused(name: str) -> None:
    """It would break the line that it is written to, or deceive who reads it."""
    with pytest.raises(MalformedMessageError, match=r"^metric: name: found '") as caught:
        EpisodeMetric(name=name, value=1.0)
    assert str(caught.value).endswith(", expected 1 to 96 printable characters")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_metric_is_a_finite_number(value: float) -> None:
    """One that is none makes none of every mean."""
    with pytest.raises(MalformedMessageError) as caught:
        EpisodeMetric(name="x", value=value)
    assert str(caught.value) == f"metric x: found {value}, expected a finite number"


def test_the_reason_does_not_grow_with_what_was_found() -> None:
    """A peer chooses what it sends, not how long our logs are."""
    with pytest.raises(MalformedMessageError) as caught:
        make_segment(actor="x\n" * 100_000)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wait_s", [-0.1, float("nan"), float("inf")])
def test_an_actor_cannot_be_told_to_wait_for_ever(wait_s: float) -> None:
    """Nothing hangs."""
    with pytest.raises(MalformedMessageError, match="ack: wait_s"):
        Ack(
            verdict="accepted",
            reason="",
            generation=1,
            epoch=0,
            weights_version=0,
            wait_s=wait_s,
        )


@pytest.mark.parametrize("quota_steps", [0, -1])
def test_a_quota_asks_for_something(quota_steps: int) -> None:
    """Otherwise an actor in lockstep would send nothing and wait for nothing."""
    with pytest.raises(MalformedMessageError, match="notice: quota_steps"):
        make_notice(quota_steps=quota_steps)


def test_weights_are_the_same_when_generation_and_version_are() -> None:
    """A restarted learner may publish a version a second time, with other networks."""
    assert make_notice(epoch=1).identity == make_notice(epoch=2).identity == (3, 8)
    assert make_notice(generation=4).identity != make_notice().identity


def test_messages_cannot_be_changed() -> None:
    """They are handed from thread to thread."""
    with pytest.raises(FrozenInstanceError):
        make_notice().version = 9  # type: ignore[misc]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a", True),
        ("host-0_b.2", True),
        ("0", True),
        ("_", True),
        ("a" * 96, True),
        ("a" * 97, False),
        ("", False),
        ("-a", False),
        (".a", False),
        ("a\n", False),
        ("a/b", False),
        ("a*", False),
        ("ä", False),
        ("٣", False),
    ],
)
def test_a_name_is_ascii_and_fits_in_a_key(text: str, expected: bool) -> None:
    """Letters, digits and three signs, not beginning with one that means something."""
    assert is_name(text) is expected
