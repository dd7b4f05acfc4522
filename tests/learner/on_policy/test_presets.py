"""Presets, overrides and what is refused."""

import dataclasses
import math

import pytest

from a2s.learner.on_policy.hyperparameters import OnPolicyHyper
from a2s.learner.on_policy.presets import PRESETS, choices, on_policy
from a2s.learner.run.overrides import parse
from a2s.protocol.errors import UsageError

TYPES = {field.name: field.type for field in dataclasses.fields(OnPolicyHyper)}


@pytest.mark.parametrize("algo", ["a2s", "a2c"])
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_complete_and_valid(preset: str, algo: str) -> None:
    """Each value has a source."""
    hyper = on_policy(preset, algo, {})
    assert sorted(choices(preset, algo)) == sorted(TYPES)
    assert hyper.uses_q is (algo == "a2s")
    assert all(choice.source for choice in choices(preset, algo).values())


def test_authors_have_the_values_of_table_3() -> None:
    """Gamma, wanted divergence, deviation, alpha, K."""
    hyper = on_policy("authors", "a2s", {})
    found = (hyper.gamma, hyper.kl_target, hyper.std, hyper.recovery_bias, hyper.suggestions)
    assert found == (0.97, 1e-3, 0.5, 0.65, 10)


@pytest.mark.parametrize("preset", PRESETS)
def test_a2c_is_a2s_with_one_suggestion_and_neither_equation(preset: str) -> None:
    """For every preset."""
    a2c = on_policy(preset, "a2c", {})
    same = {"suggestions": 1, "distil": "off", "recovery": "off", "advantage": a2c.advantage}
    assert a2c == on_policy(preset, "a2s", same)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("suggestions", "16", 16),
        ("batch_steps", "1e4", 10_000),
        ("batch_steps", "4096.0", 4096),
        ("batch_steps", 1e4, 10_000),
        ("gamma", ".9", 0.9),
        ("kl_stop", "inf", math.inf),
        ("learn_std", "false", False),
        ("selection", "hard", "hard"),
        ("q_sizes", "256,128", (256, 128)),
        ("q_sizes", "256-128", (256, 128)),
        ("q_sizes", "[256, 128]", (256, 128)),
        ("q_sizes", "32", (32,)),
        ("q_sizes", [32, 16], (32, 16)),
        ("q_sizes", [32.0, 16], (32, 16)),
        ("gamma", 1, 1.0),
    ],
)
def test_overrides_are_read_by_the_type_of_their_field(
    name: str, text: object, value: object
) -> None:
    """They come as text from a command line."""
    found = getattr(on_policy("modern", "a2s", {name: text}), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"suggestions": 0}, "suggestions: found 0, expected a whole number from 1 to 1024"),
        ({"suggestions": "ten"}, "suggestions: found 'ten', expected a whole number"),
        ({"suggestions": True}, "suggestions: found True, expected a whole number from 1 to 1024"),
        ({"batch_steps": "1.5e0"}, "batch_steps: found '1.5e0', expected a whole number"),
        ({"batch_steps": "nan"}, "batch_steps: found 'nan', expected a whole number"),
        ({"batch_steps": 0.5}, "batch_steps: found 0.5, expected a whole number"),
        ({"batch_steps": math.inf}, "batch_steps: found inf, expected a whole number"),
        ({"suggestions": "1e9"}, "suggestions: found 10+, expected a whole number from 1 to 1024"),
        ({"q_sizes": [1.5]}, r"q_sizes: found \[1.5\], expected whole numbers such as 64,64"),
        ({"batch_steps": "0"}, "batch_steps: found 0, expected a whole number of at least 1"),
        ({"gamma": "nan"}, "gamma: found nan, expected a number from 1e-06 to 1"),
        ({"gamma": 1.5}, "gamma: found 1.5, expected a number from 1e-06 to 1"),
        ({"selection": "sotf"}, "selection: found 'sotf', expected one of hard, soft"),
        ({"layer_norm": "maybe"}, "layer_norm: found 'maybe', expected true or false"),
        ({"layer_norm": 1}, "layer_norm: found 1, expected true or false"),
        ({"q_sizes": "a,b"}, "q_sizes: found 'a,b', expected whole numbers such as 64,64"),
        ({"q_sizes": "64,0"}, "q_sizes: found 0, expected a whole number from 1 to 65536"),
        ({"distil_top": 11}, r"distil_top: found 11, expected at most distil_suggestions \(10\)"),
        ({"min_episodes": 3}, "min_episodes: found 3, expected 0 while whole_episodes is false"),
        (
            {"whole_episodes": True},
            "min_episodes: found 0, expected at least 1 while whole_episodes is true",
        ),
        ({"gama": 1.0}, r"unknown hyperparameter 'gama' \(did you mean 'gamma'\?\)"),
    ],
)
def test_wrong_values_are_refused_in_one_line(overrides: dict[str, object], message: str) -> None:
    """Subject, what was found, what was expected."""
    with pytest.raises(UsageError, match=f"^{message}$"):
        on_policy("modern", "a2s", overrides)


def test_unknown_preset_and_algo_name_the_nearest() -> None:
    """As for hyperparameters."""
    with pytest.raises(UsageError, match=r"unknown preset 'moden' \(did you mean 'modern'\?\)"):
        on_policy("moden", "a2s", {})
    with pytest.raises(UsageError, match="unknown algo 'a3c'"):
        on_policy("modern", "a3c", {})


def test_a2c_refuses_several_suggestions() -> None:
    """They would contradict each other silently."""
    with pytest.raises(UsageError, match="suggestions: found 4, expected 1 with algo a2c"):
        on_policy("modern", "a2c", {"suggestions": "4"})


def test_a2c_may_have_the_stabiliser() -> None:
    """Section 6 of the paper: most of them are compatible with A2C."""
    assert on_policy("modern", "a2c", {"recovery": "invariant"}).recovery == "invariant"


def test_values_are_parsed_alike_from_text_and_file() -> None:
    """Every value of a preset survives being printed."""
    for name, choice in choices("modern", "a2s").items():
        text = str(choice.value).strip("()")
        assert parse(name, text, TYPES) == choice.value


def test_batches_grow_from_the_first_to_the_last_size() -> None:
    """By 1.5: 512, 768, 1152, 1728, then the last."""
    hyper = on_policy(
        "modern", "a2s", {"batch_steps": 2048, "batch_steps_first": 512, "batch_growth": 1.5}
    )
    assert [hyper.batch_steps_at(update) for update in range(5)] == [512, 768, 1152, 1728, 2048]
    assert hyper.batch_steps_at(10**9) == 2048
