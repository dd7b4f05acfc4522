"""How an environment is made: what is refused, and what its words mean."""

import json
from typing import Any

import pytest

from a2s.protocol.env_config import EnvConfig, kwargs_of, wrapper_of
from a2s.protocol.errors import A2SError, MalformedMessageError, UsageError
from a2s.protocol.fields import MAX_METRICS

DEEP = 450_000
MOST = 2**31 - 1


def make(**changes: Any) -> EnvConfig:
    """Make an environment's configuration."""
    return EnvConfig(**{"env_id": "E", **changes})


def one_line(error: A2SError) -> str:
    """Return the reason, which an operator can read."""
    reason = str(error)
    assert reason.isprintable()
    assert len(reason) < 250
    return reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"env_id": ""}, "environment: found '', expected an id"),
        ({"action_repeat": 0}, f"environment: action_repeat: found 0, expected 1 to {MOST}"),
        (
            {"action_repeat": 2**31},
            f"environment: action_repeat: found {2**31}, expected 1 to {MOST}",
        ),
        ({"frame_stack": -1}, f"environment: frame_stack: found -1, expected 1 to {MOST}"),
        (
            {"max_episode_steps": -1},
            f"environment: max_episode_steps: found -1, expected 0 to {MOST}",
        ),
        ({"timeout_s": 0.0}, "environment: timeout_s: found 0.0, expected above 0 s"),
        ({"timeout_s": -1.0}, "environment: timeout_s: found -1.0, expected above 0 s"),
        ({"timeout_s": float("nan")}, "environment: timeout_s: found nan, expected above 0 s"),
        ({"timeout_s": float("inf")}, "environment: timeout_s: found inf, expected above 0 s"),
        (
            {"info_metrics": ("a\nb",)},
            "environment: info_metrics: found 'a\\nb', expected 1 to 96 printable characters",
        ),
        (
            {"info_metrics": ("",)},
            "environment: info_metrics: found '', expected 1 to 96 printable characters",
        ),
        (
            {"info_metrics": tuple(f"m{i}" for i in range(MAX_METRICS))},
            "environment: info_metrics: found 33, expected at most 32 with is_success",
        ),
    ],
)
def test_what_no_environment_can_be_made_with_is_refused(
    changes: dict[str, Any], reason: str
) -> None:
    """By name; a learner tells its user, an actor refuses the Welcome."""
    with pytest.raises(MalformedMessageError) as caught:
        make(**changes)
    assert one_line(caught.value) == reason


def test_the_limits_themselves_are_allowed() -> None:
    """As the page says."""
    names = tuple(f"m{i}" for i in range(MAX_METRICS - 1))
    config = make(
        action_repeat=MOST, frame_stack=MOST, max_episode_steps=MOST, timeout_s=1e-9,
        info_metrics=names,
    )  # fmt: skip
    assert config.metric_names == ("is_success", *names)


@pytest.mark.parametrize(
    "kwargs",
    [
        pytest.param("", id="empty"),
        pytest.param("[]", id="array"),
        pytest.param("null", id="null"),
        pytest.param("1", id="number"),
        pytest.param('"a"', id="text"),
        pytest.param("{'a': 1}", id="Python's quotes"),
        pytest.param('{"a": 1}}', id="something after it"),
        pytest.param('{"a":\n\x1b[31m', id="torn, with lines and colours"),
        pytest.param('{"a": ' + "9" * 5000 + "}", id="a number that takes long to read"),
        pytest.param("[" * 900_000, id="900 KB of brackets"),
        pytest.param('{"a":' + "[" * DEEP + "]" * DEEP + "}", id="900 KB that are closed"),
        pytest.param('{"a":' * (DEEP // 3) + "1" + "}" * (DEEP // 3), id="objects in objects"),
    ],
)
def test_arguments_that_are_no_json_object_are_refused(kwargs: str) -> None:
    """Also those that the reader has no stack for: nothing but this error leaves it."""
    with pytest.raises(MalformedMessageError) as caught:
        make(kwargs=kwargs)
    reason = one_line(caught.value)
    assert reason.startswith("environment: kwargs: found ")
    assert reason.endswith(", expected a JSON object")


def test_a_text_among_the_arguments_is_filled_in() -> None:
    """A port or a directory for each environment; a number alone becomes a number."""
    config = make(
        kwargs='{"port": "{worker}", "log": "w{worker}-e{env_index}", "n": 1, "in": ["{worker}"]}'
    )
    assert config.constructor_arguments(3, 7) == {
        "port": 3,
        "log": "w3-e7",
        "n": 1,
        "in": ["{worker}"],
    }


def test_is_success_is_always_looked_at_and_nothing_twice() -> None:
    """A metric has one value in an episode."""
    assert make().metric_names == ("is_success",)
    assert make(info_metrics=("a", "is_success", "b", "a")).metric_names == ("is_success", "a", "b")


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("n=1", 1),
        ("n=1.5", 1.5),
        ("n=true", True),
        ("n=null", None),
        ("n= null ", None),
        ("n=[1, 2]", [1, 2]),
        ('n={"a": 1}', {"a": 1}),
        ("n=text", "text"),
        ('n="1"', "1"),
        ("n=a=b", "a=b"),
        ("n=", ""),
        ("n=True", "True"),
        ("n={worker}", "{worker}"),
        (" n =1", 1),
    ],
)
def test_a_setting_is_json_or_a_text(setting: str, value: Any) -> None:
    """As a user writes it in a shell."""
    assert json.loads(kwargs_of([setting])) == {"n": value}
    assert type(json.loads(kwargs_of([setting]))["n"]) is type(value)


@pytest.mark.parametrize("setting", ["", "n", "=1", "a b=1", "1=1", "a.b=1"])
def test_a_setting_that_names_nothing_is_refused(setting: str) -> None:
    """It cannot be a keyword argument."""
    with pytest.raises(UsageError) as caught:
        kwargs_of([setting])
    assert one_line(caught.value) == f"--env-kwargs: found {setting!r}, expected KEY=VALUE"


def test_a_wrapper_is_a_class_with_or_without_arguments() -> None:
    """Its module may be a file."""
    assert wrapper_of("m.n:C") == ("m.n", "C", {})
    assert wrapper_of(' ./f.py:C={"a": [1]}') == ("./f.py", "C", {"a": [1]})


@pytest.mark.parametrize(
    "setting",
    [
        "",
        "C",
        ":C",
        "m:",
        "m:C=",
        "m:C=[]",
        "m:C={",
        "m:C D",
        "m:C=" + "[" * 900_000,
        "\n" * 900_000,
    ],
)
def test_a_wrapper_that_is_none_is_refused(setting: str) -> None:
    """The line shows a good one, and no more of a bad one than fits."""
    with pytest.raises(UsageError, match=r"^--wrapper: found '") as caught:
        wrapper_of(setting)
    assert "expected module:Class or module:Class=" in one_line(caught.value)
