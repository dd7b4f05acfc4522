"""Off-policy presets, overrides and what is refused."""

import dataclasses
import sys

import pytest
import torch

from a2s.learner.off_policy.hyperparameters import OffPolicyHyper
from a2s.learner.off_policy.presets import PRESETS, choices, off_policy
from a2s.protocol.errors import UsageError

NAMES = [field.name for field in dataclasses.fields(OffPolicyHyper)]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_complete_and_valid(preset: str) -> None:
    """Each value has a source."""
    off_policy(preset, {})
    assert list(choices(preset)) == NAMES
    assert all(choice.source for choice in choices(preset).values())


def test_sac_is_modern_with_one_suggestion_one_value_and_plain_networks() -> None:
    """The same sizes and rates of the networks, observations normalised; its own discount."""
    sac, modern = off_policy("sac", {}), off_policy("modern", {})
    differ = {name for name in NAMES if getattr(sac, name) != getattr(modern, name)}
    assert differ == {
        "act_suggestions", "quantiles", "dropped_quantiles", "network", "tau", "average_updates",
        "selection", "normalise_return", "huber_width", "initial_temperature",
        "temperature_learning_rate", "gamma",
    }  # fmt: skip
    assert (sac.quantiles, sac.network) == (1, "mlp")
    assert (sac.act_suggestions, sac.target_suggestions, sac.target_groups) == (1, 1, 1)
    assert (sac.policy_loss, sac.gamma) == ("pathwise", 0.99)


@pytest.mark.parametrize(
    ("total_steps", "expected"),
    [(5, 1), (2_000, 200), (49_990, 4_999), (50_000, 5_000), (10**6, 5_000)],
)
def test_at_most_a_tenth_of_a_run_is_warm_up(total_steps: int, expected: int) -> None:
    """Or a short run would end before it learns anything; what is set stays."""
    assert off_policy("modern", {}, total_steps).warm_up_steps == expected
    assert off_policy("modern", {"warm_up_steps": "70"}, total_steps).warm_up_steps == 70


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux")
def test_matrix_products_are_in_bf16_where_the_processor_multiplies_it() -> None:
    """As torch finds it; and in f32 where that is wanted."""
    found = torch.cpu.get_capabilities()
    multiplies = found.get("avx512_bf16", False) or found.get("amx_bf16", False)
    assert off_policy("modern", {}).precision == ("bf16" if multiplies else "f32")
    assert off_policy("modern", {"precision": "f32"}).precision == "f32"


def test_paper_has_neither_entropy_nor_target_networks() -> None:
    """Algorithm 2 as printed, N x K suggestions, one Q."""
    paper = off_policy("paper", {})
    assert paper.initial_temperature == paper.temperature_learning_rate == 0
    assert (paper.tau, paper.critics, paper.policy_loss) == (1.0, 1, "score")
    assert (paper.target_suggestions, paper.gamma) == (10, 0.97)
    assert paper.target_groups > 1


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("target_suggestions", "16", 16),
        ("prioritised", "true", True),
        ("critic_sizes", "512-512", (512, 512)),
        ("network", "residual", "residual"),
        ("tau", 1, 1.0),
    ],
)
def test_overrides_are_read_by_the_type_of_their_field(
    name: str, text: object, value: object
) -> None:
    """They come as text from a command line."""
    found = getattr(off_policy("modern", {name: text}), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"act_suggestions": 0},
            "act_suggestions: found 0, expected a whole number from 1 to 1024",
        ),
        ({"warm_up_steps": 0}, "warm_up_steps: found 0, expected a whole number of at least 1"),
        ({"tau": 0}, "tau: found 0.0, expected a number from 1e-06 to 1"),
        ({"network": "cnn"}, "network: found 'cnn', expected one of mlp, residual, trunk"),
        (
            {"network": "trunk", "critic_sizes": "9"},
            r"critic_sizes: found \(9,\), expected at least two with network trunk",
        ),
        ({"precision": "f16"}, "precision: found 'f16', expected one of f32, bf16"),
        (
            {"replay_rows": 10**18},
            r"replay_rows: found 10+, expected a whole number from 1 to 1e\+09",
        ),
        ({"replay_rows": 9}, r"batch_rows: found 256, expected at most replay_rows \(9\)"),
        (
            {"send_every_steps": 300, "lead_steps": 300, "replay_rows": 256},
            r"send_every_steps: found 300, expected at most replay_rows \(256\)",
        ),
        ({"priority_exponent": 1.5}, "priority_exponent: found 1.5, expected a number from 0 to 1"),
        ({"lead_steps": 1}, r"send_every_steps: found \d+, expected at most lead_steps \(1\)"),
        (
            {"quantiles": 5, "dropped_quantiles": 5},
            r"dropped_quantiles: found 5, expected fewer than quantiles \(5\)",
        ),
        (
            {"policy_loss": "score", "distil_suggestions": 1},
            "distil_suggestions: found 1, expected at least 2 with policy_loss score",
        ),
        (
            {"initial_temperature": 0, "temperature_learning_rate": 0},
            "initial_temperature: found 0.0, expected above 0 with selection soft",
        ),
        (
            {"initial_temperature": 0, "selection": "hard"},
            "initial_temperature: found 0.0, expected above 0 where temperature_learning_rate is",
        ),
        ({"kapa": 1}, "unknown hyperparameter 'kapa'.*"),
        ({"taus": 1}, r"unknown hyperparameter 'taus' \(did you mean 'tau'\?\)"),
    ],
)
def test_wrong_values_are_refused_in_one_line(overrides: dict[str, object], message: str) -> None:
    """Subject, what was found, what was expected."""
    with pytest.raises(UsageError, match=f"^{message}$"):
        off_policy("modern", overrides)


def test_no_temperature_is_needed_where_nothing_is_drawn_among() -> None:
    """With one suggestion ``soft`` and ``hard`` are the same."""
    without = {"initial_temperature": 0, "temperature_learning_rate": 0}
    assert off_policy("modern", without | {"act_suggestions": 1}).initial_temperature == 0


def test_unknown_preset_names_the_nearest() -> None:
    """As for hyperparameters."""
    with pytest.raises(UsageError, match=r"unknown preset 'moderm' \(did you mean 'modern'\?\)"):
        off_policy("moderm", {})
