"""What messages demand of themselves, whoever makes them."""

from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from message_examples import ENV, EXAMPLES, SPACES, f32

from a2s.protocol.checks import MAX_METRICS, is_name
from a2s.protocol.errors import MalformedMessageError
from a2s.protocol.evaluation_messages import EvaluationResult, EvaluationTask
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import (
    Ack,
    ActorStatus,
    EpisodeMetric,
    Hello,
    Notice,
    RecoveryEvent,
    RunStatus,
    Segment,
    Welcome,
)
from a2s.protocol.replay_messages import ReplayInfo, ReplaySample

HELLO, SEGMENT, ACK, NOTICE, STATUS, WELCOME = (
    EXAMPLES[kind][0] for kind in (Hello, Segment, Ack, Notice, ActorStatus, Welcome)
)
PLANE = Spaces(obs_size=3, action_low=f32([-1, -1]), action_high=f32([0, 0]))
METRIC = EpisodeMetric(name="x", value=1.0)
METRICS = tuple(EpisodeMetric(name=f"m{i}", value=1.0) for i in range(MAX_METRICS + 1))
NAME = "expected at most 96 of letters, digits, _ . -, beginning with no . or -"
LABEL = "expected 1 to 96 printable characters"
LONG = "x\n" * 400_000
MAX_INT32 = 2**31 - 1
NAN, INF = float("nan"), float("inf")


def zeros(*shape: int) -> Array:
    """Make float32 zeros."""
    return np.zeros(shape, np.float32)


def too_large(name: str, shape: tuple[int, ...], limit: float) -> list[tuple[Any, Any, str]]:
    """Make the rows of an array of a segment with numbers beyond a limit."""
    return [
        (SEGMENT, {name: zeros(*shape) + value},
         f"segment h-1/7: {name}: found {abs(value)}, expected at most {limit:g} in size")
        for value in (NAN, INF, -INF, 2 * limit, -2 * limit)
    ]  # fmt: skip


IMPOSSIBLE: list[tuple[Any, dict[str, Any], str]] = [
    (PLANE, {"obs_size": 0}, "spaces: obs_size: found 0, expected 1..2097152"),
    (PLANE, {"obs_size": -3}, "spaces: obs_size: found -3, expected 1..2097152"),
    (PLANE, {"obs_size": 2**21 + 1}, "spaces: obs_size: found 2097153, expected 1..2097152"),
    (PLANE, {"action_low": zeros(0)}, "spaces: action_low: found (0,), expected shape [A]"),
    (PLANE, {"action_low": zeros(2, 1)}, "spaces: action_low: found (2, 1), expected shape [A]"),
    (PLANE, {"action_high": zeros(3)}, "spaces: action_high: found (3,), expected (2,)"),
    (PLANE, {"action_high": zeros(2) + INF},
     "spaces: action_high: found 2 non-finite values, expected finite numbers"),
    (PLANE, {"action_low": zeros(2)},  # as high as action_high
     "spaces: found low >= high, expected low below high everywhere"),
    (PLANE, {"obs_offset": zeros(2)}, "spaces: obs_offset: found (2,), expected (3,)"),
    (PLANE, {"obs_offset": zeros(3, 1)}, "spaces: obs_offset: found (3, 1), expected (3,)"),
    (PLANE, {"obs_offset": f32([NAN, INF, -INF])},
     "spaces: obs_offset: found 3 non-finite values, expected finite numbers"),

    *((message, {"actor": actor}, f"{where}: actor: found {actor!r}, {NAME}")
      for actor in ("", "a/b", "*")
      for message, where in ((HELLO, "hello"), (SEGMENT, "segment"), (STATUS, "actor status"))),
    *((HELLO, change, "hello: env_id: found '") for change in ({"env_id": ""}, {"spaces": None})),
    *((HELLO, {"num_envs": num_envs}, f"hello: num_envs: found {num_envs}, expected 1..4096")
      for num_envs in (0, -1, 4097)),
    (HELLO, {"next_seq": -2}, "hello: next_seq: found -2, expected -1 or more"),
    (HELLO, {"spaces": None, "env_id": ""}, "hello: num_envs: found 2, expected 0..0"),
    *((HELLO, {"slot": slot}, f"hello: slot: found {slot}, expected -1..999999")
      for slot in (-2, 1_000_000)),

    (SEGMENT, {"obs": zeros(1)}, "segment h-1/7: found (1,), expected obs [T, D]"),
    (SEGMENT, {"obs": zeros(0, 1)}, "segment h-1/7: found (0, 1), expected obs [T, D]"),
    (SEGMENT, {"suggestion": zeros(1)}, "segment h-1/7: found (1,), expected suggestion [T, A]"),
    *((SEGMENT, {name: zeros(*shape)}, "segment h-1/7: arrays disagree about T: found {'obs': ")
      for name, shape in [("obs", (2, 1)), ("suggestion", (2, 1)), ("log_prob", (1, 1)),
                          ("reward", (2,)), ("reward", ())]),
    *((SEGMENT, {"final_obs": zeros(*shape)},
       f"segment h-1/7: final_obs: found {shape}, expected (1,) as in obs")
      for shape in ((2,), (1, 1))),
    (SEGMENT, {"truncated": True}, "segment h-1/7: found both ends, expected one of them"),
    (SEGMENT, {"seq": -1}, "segment h-1/-1: seq: found -1, expected >= 0"),
    *((SEGMENT, {name: -1}, f"segment h-1/7: {name}: found -1, expected >= 0")
      for name in ("generation", "epoch", "weights_version", "env")),
    (SEGMENT, {"episode_length": 0}, "segment h-1/7: found 0, expected episode_length >= T"),
    (SEGMENT, {"metrics": METRICS}, "segment h-1/7: metrics: found 33, expected at most 32"),
    *too_large("obs", (1, 1), 1e10), *too_large("final_obs", (1,), 1e10),
    *too_large("reward", (1,), 1e10), *too_large("suggestion", (1, 1), 1e6),
    *too_large("log_prob", (1,), 1e6),
    *((SEGMENT, {"episode_return": value}, "segment h-1/7: episode_return: found ")
      for value in (NAN, INF, -2e10)),

    *((METRIC, {"name": name}, "metric: name: found '")
      for name in ("", "x" * 97, "a\nb", "a\r", "\t", "a\0", "\x1b[31m", "\x7f", "a\u2028b",
                   "\u202e", "\ud800", LONG)),
    *((METRIC, {"value": value}, f"metric x: found {value}, expected a finite number")
      for value in (NAN, INF, -INF)),
    *((ACK, {"wait_s": value}, f"ack: wait_s: found {value}, expected 0 to 1e+06 seconds")
      for value in (-0.1, NAN, INF, 1.1e6)),
    *((STATUS, {f"{name}_s": value}, f"actor status: {name}_s: found {value}, expected 0 or more")
      for name in ("environment", "selection", "sending", "waiting") for value in (-0.1, NAN, INF)),
    *((message, {"slot": slot}, f"{where}: slot: found {slot}, expected -1..999999")
      for message, where in ((STATUS, "actor status"), (WELCOME, "welcome"))
      for slot in (-5, 1_000_000)),
    *((message, {name: -1}, f"{where}: {name}: found -1, expected >= 0")
      for message, where, names in (
          (STATUS, "actor status", (
              "weights_version", "epoch", "env_steps", "episodes", "segments_sent",
              "segments_answered", "spooled_steps", "dropped_steps")),
          (ACK, "ack", ("generation", "epoch", "weights_version")),
          (NOTICE, "notice", ("generation", "epoch", "version", "quota_episodes", "num_bytes")),
          (WELCOME, "welcome", ("generation", "seed")),
          (EXAMPLES[RunStatus][0], "run status", (
              "generation", "env_steps", "episodes", "updates", "weights_version", "epoch",
              "evaluation_steps")),
          (EXAMPLES[RecoveryEvent][0], "recovery", (
              "id", "generation", "epoch", "restored_version", "weights_version")),
          (EXAMPLES[ReplayInfo][0], "replay", ("generation", "begin", "capacity")),
          (EXAMPLES[EvaluationTask][0], "evaluation", (
              "generation", "number", "env_steps", "weights_version")),
          (EXAMPLES[EvaluationResult][0], "evaluation", ("generation", "number")),
      )
      for name in names),
    (WELCOME, {"num_envs": 0}, "welcome: num_envs: found 0, expected 1..4096"),
    (WELCOME, {"run": "a/b"}, f"welcome: run: found 'a/b', {NAME}"),
    (NOTICE, {"sha256": "a" * 65}, "notice: sha256: found 'aaa"),
    (EXAMPLES[RunStatus][0], {"total_steps": 0}, "run status: total_steps: found 0, expected at"),
    (EXAMPLES[ReplayInfo][0], {"end": 1}, "replay: end: found 1, expected >= 2"),
    (EXAMPLES[ReplaySample][0], {"begin": 6}, "replay sample: end: found 5, expected >= 6"),
    *((EXAMPLES[ReplaySample][0], {name: np.float32(1.0).reshape(())},
       f"replay sample: {name}: found (), expected rank {rank}")
      for name, rank in (("reward", 1), ("obs", 2))),
    *((EXAMPLES[ReplaySample][0], {"row": (row,)}, f"replay sample: row: found [{row}], expected 0")
      for row in (-1, 5)),
    *((NOTICE, {"quota_steps": value}, f"notice: quota_steps: found {value}, expected at least 1")
      for value in (0, -1)),

    (ENV, {"env_id": ""}, "environment: found '', expected an id"),
    *((ENV, {name: value}, f"environment: {name}: found {value}, expected {low} to {MAX_INT32}")
      for name, low in (("action_repeat", 1), ("frame_stack", 1), ("max_episode_steps", 0))
      for value in (low - 1, MAX_INT32 + 1)),
    *((ENV, {"timeout_s": value}, f"environment: timeout_s: found {value}, expected above 0 s")
      for value in (0.0, -1.0, NAN, INF)),
    (ENV, {"info_metrics": ("a\nb",)}, f"environment: info_metrics: found 'a\\nb', {LABEL}"),
    (ENV, {"info_metrics": ("",)}, f"environment: info_metrics: found '', {LABEL}"),
    (ENV, {"info_metrics": tuple(m.name for m in METRICS[1:])},
     "environment: info_metrics: found 33, expected at most 32 with is_success"),
]  # fmt: skip


@pytest.mark.parametrize(("message", "changes", "reason"), IMPOSSIBLE)
def test_what_contradicts_itself_is_refused_at_the_sender(
    message: Any, changes: dict[str, Any], reason: str
) -> None:
    """In one short line."""
    with pytest.raises(MalformedMessageError) as caught:
        replace(message, **changes)
    found = str(caught.value)
    assert found.startswith(reason)
    assert found.isprintable()
    assert len(found) < 250


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        (HELLO, {"num_envs": 0, "env_id": "", "spaces": None}),  # it asks
        (HELLO, {"num_envs": 4096, "slot": 999_999, "actor": "a" * 96}),
        (SEGMENT, {"metrics": METRICS[1:], "obs": f32([[-1e10]]), "log_prob": f32([1e6])}),
        *((METRIC, {"name": name, "value": -1e300})
          for name in ("is_success", "a", "dist to goal, m", 'é/"ü"', "路", "x" * 96, " ")),
        (ENV, {"action_repeat": MAX_INT32, "frame_stack": MAX_INT32, "timeout_s": 1e-9,
               "max_episode_steps": MAX_INT32,
               "info_metrics": tuple(m.name for m in METRICS[2:])}),
    ],
)  # fmt: skip
def test_the_limits_themselves_are_allowed(message: Any, changes: dict[str, Any]) -> None:
    """As ``docs/protocol.md`` says."""
    replace(message, **changes)


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({}, ""),
        ({"obs_size": 4}, "obs_size 4, expected 3"),
        ({"action_low": f32([-1]), "action_high": f32([0])}, "action_size 1, expected 2"),
        ({"action_low": f32([-2, -2])}, "action_low [-2.0, -2.0], expected [-1.0, -1.0]"),
        ({"action_high": f32([2, 2])}, "action_high [2.0, 2.0], expected [0.0, 0.0]"),
        ({"obs_offset": f32([1, 1, 1])}, ""),  # the learner's choice
    ],
)
def test_the_difference_of_spaces_says_what_the_other_has(
    changes: dict[str, Any], difference: str
) -> None:
    """A refused actor reads it."""
    assert PLANE.differs_from(replace(PLANE, **changes)) == difference
    assert (PLANE.action_size, SPACES.action_size) == (2, 1)


@pytest.mark.parametrize(
    ("terminated", "truncated"), [(False, False), (True, False), (False, True)]
)
def test_a_segment_knows_whether_the_episode_ended(terminated: int, truncated: int) -> None:
    """Either end is an end."""
    segment = replace(SEGMENT, terminated=terminated > 0, truncated=truncated > 0)
    assert (segment.num_steps, segment.ends_episode) == (1, bool(terminated or truncated))


def test_weights_are_the_same_when_generation_and_version_are() -> None:
    """A restarted learner may publish a version a second time, with other networks."""
    assert NOTICE.identity == replace(NOTICE, epoch=7).identity == (1, 2)
    assert replace(NOTICE, generation=4).identity != NOTICE.identity


def test_messages_cannot_be_changed() -> None:
    """They are handed from thread to thread."""
    with pytest.raises(FrozenInstanceError):
        NOTICE.version = 9


def test_a_name_is_ascii_and_fits_in_a_key() -> None:
    """Letters, digits and three signs, not beginning with one that means something."""
    assert all(map(is_name, ("a", "host-0_b.2", "0", "_", "a" * 96)))
    wrong = ("a" * 97, "", "-a", ".a", "a\n", "a/b", "a*", "ä", "٣")
    assert not any(map(is_name, wrong))
