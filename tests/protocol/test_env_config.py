"""How an environment is made: what is refused, and what its words mean."""

import json
from typing import Any

import pytest

from a2s.protocol.env_config import EnvConfig, kwargs_of, wrapper_of
from a2s.protocol.errors import MalformedMessageError, UsageError

DEEP = 450_000


@pytest.mark.parametrize(
    "kwargs",
    [
        "", "[]", "null", "1", '"a"', "{'a': 1}", '{"a": 1}}', '{"a":\n\x1b[31m',
        pytest.param('{"a": ' + "9" * 5000 + "}", id="a number that takes long to read"),
        pytest.param("[" * 900_000, id="900 KB of brackets"),
        pytest.param('{"a":' + "[" * DEEP + "]" * DEEP + "}", id="900 KB that are closed"),
        pytest.param('{"a":' * (DEEP // 3) + "1" + "}" * (DEEP // 3), id="objects in objects"),
    ],
)  # fmt: skip
def test_arguments_that_are_no_json_object_are_refused(kwargs: str) -> None:
    """Also those that the reader has no stack for: nothing but this error leaves it."""
    with pytest.raises(MalformedMessageError) as caught:
        EnvConfig(env_id="E", kwargs=kwargs)
    reason = str(caught.value)
    assert reason.startswith("environment: kwargs: found ")
    assert reason.endswith(", expected a JSON object")
    assert reason.isprintable()
    assert len(reason) < 250


def test_an_environment_in_json_is_read_again_and_what_is_unknown_is_ignored() -> None:
    """Of a later release, for example."""
    config = EnvConfig(env_id="E", kwargs='{"n": 1}', wrappers=("m:C",), timeout_s=0.5)
    later = json.dumps({**json.loads(config.to_json()), "colour": "red"})
    assert EnvConfig.from_json(later) == config


def test_a_text_among_the_arguments_is_filled_in() -> None:
    """A port or a directory for each environment; a number alone becomes a number."""
    config = EnvConfig(
        env_id="E",
        kwargs='{"port": "{worker}", "log": "w{worker}-e{env_index}", "n": 1, "in": ["{worker}"]}',
    )
    expected = {"port": 3, "log": "w3-e7", "n": 1, "in": ["{worker}"]}
    assert config.constructor_arguments(3, 7) == expected


def test_is_success_is_always_looked_at_and_nothing_twice() -> None:
    """A metric has one value in an episode."""
    assert EnvConfig(env_id="E").metric_names == ("is_success",)
    config = EnvConfig(env_id="E", info_metrics=("a", "is_success", "b", "a"))
    assert config.metric_names == ("is_success", "a", "b")


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("n=1", 1), ("n=1.5", 1.5), ("n=true", True), ("n=null", None), ("n= null ", None),
        ("n=[1, 2]", [1, 2]), ('n={"a": 1}', {"a": 1}), ("n=text", "text"), ('n="1"', "1"),
        ("n=a=b", "a=b"), ("n=", ""), ("n=True", "True"), ("n={worker}", "{worker}"), (" n =1", 1),
    ],
)  # fmt: skip
def test_a_setting_is_json_or_a_text(setting: str, value: Any) -> None:
    """As a user writes it in a shell."""
    found = json.loads(kwargs_of([setting]))
    assert found == {"n": value}
    assert type(found["n"]) is type(value)


@pytest.mark.parametrize("setting", ["", "n", "=1", "a b=1", "1=1", "a.b=1"])
def test_a_setting_that_names_nothing_is_refused(setting: str) -> None:
    """It cannot be a keyword argument."""
    with pytest.raises(UsageError) as caught:
        kwargs_of([setting])
    assert str(caught.value) == f"--env-kwargs: found {setting!r}, expected KEY=VALUE"


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
def test_a_wrapper_that_cannot_be_read_is_refused(setting: str) -> None:
    """The line shows a good one, and no more of a bad one than fits."""
    with pytest.raises(UsageError, match=r"^--wrapper: found '") as caught:
        wrapper_of(setting)
    assert "expected module:Class or module:Class=" in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 250
