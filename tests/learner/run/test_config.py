"""Presets, changed hyperparameters, and what is refused."""

import math
from dataclasses import asdict
from pathlib import Path

import pytest

from a2s.learner.off_policy.config import PRESETS as OFF_PRESETS
from a2s.learner.on_policy.authors_config import AuthorsConfig
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.presets import PRESETS as ON_PRESETS
from a2s.learner.run import tables
from a2s.learner.run.config import fastest_precision, off_policy, on_policy
from a2s.protocol.errors import UsageError

REPO = Path(__file__).parents[3]


def test_the_page_of_hyperparameters_is_made_of_the_code() -> None:
    """`make docs` writes it."""
    assert (REPO / "docs" / "hyperparameters.md").read_text() == tables.page()


@pytest.mark.parametrize("preset", OFF_PRESETS)
def test_every_off_policy_preset_is_valid(preset: str) -> None:
    off_policy(preset, {})


@pytest.mark.parametrize("algo", ["a2s", "a2c"])
@pytest.mark.parametrize("preset", ON_PRESETS)
def test_every_on_policy_preset_is_valid(preset: str, algo: str) -> None:
    """Only a2s reads Q."""
    assert on_policy(preset, algo, {}).uses_q is (algo == "a2s")


def test_authors_have_the_values_of_table_3() -> None:
    """Gamma, wanted divergence, deviation, alpha, K."""
    hyper = AuthorsConfig()
    found = (hyper.gamma, hyper.kl_target, hyper.std, hyper.recovery_bias, hyper.suggestions)
    assert found == (0.97, 1e-3, 0.5, 0.65, 10)


@pytest.mark.parametrize("preset", ON_PRESETS)
def test_a2c_is_a2s_with_one_suggestion_and_neither_equation(preset: str) -> None:
    """For every preset."""
    same: dict[str, object] = {"suggestions": 1, "recovery": "off"}
    same |= {} if preset == "modern" else {"advantage": "return-v", "distil": "off"}
    assert on_policy(preset, "a2c", {}) == on_policy(preset, "a2s", same)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("suggestions", "16", 16),
        ("batch_steps", "1e4", 10_000),
        ("batch_steps", "4096.0", 4096),
        ("batch_steps", 1e4, 10_000),
        ("gamma", ".9", 0.9),
        ("kl_stop", "inf", math.inf),
        ("norm_obs", "false", False),
        ("lr_rule", "kl", "kl"),
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
        ({"q_sizes": [1.5]}, r"q_sizes: found \[1.5\], expected layer sizes such as 64,64"),
        ({"batch_steps": "0"}, "batch_steps: found 0, expected a whole number of at least 1"),
        ({"gamma": "nan"}, "gamma: found nan, expected a number from 1e-06 to 1"),
        ({"gamma": 1.5}, "gamma: found 1.5, expected a number from 1e-06 to 1"),
        ({"lr_rule": "k"}, "lr_rule: found 'k', expected one of constant, anneal, kl"),
        ({"layer_norm": "maybe"}, "layer_norm: found 'maybe', expected true or false"),
        ({"layer_norm": 1}, "layer_norm: found 1, expected true or false"),
        ({"q_sizes": "a,b"}, "q_sizes: found 'a,b', expected layer sizes such as 64,64"),
        ({"q_sizes": "64,0"}, "q_sizes: found 0, expected a whole number from 1 to 65536"),
        (
            {"act_while_learning": True, "max_policy_lag": 0},
            "act_while_learning: found True, expected false where max_policy_lag is 0",
        ),
        ({"std": 0.1}, r"std_floor: found 0.3, expected at most std \(0.1\)"),
        (
            {"last_std_floor": 0.4},
            r"last_std_floor: found 0.4, expected at most std_floor \(0.3\)",
        ),
        (
            {"min_episodes": 3},
            r"unknown hyperparameter 'min_episodes' \(only in the presets .*\)",
        ),
        ({"gama": 1.0}, r"unknown hyperparameter 'gama' \(did you mean 'gamma'\?\)"),
    ],
)
def test_wrong_values_are_refused_in_one_line(overrides: dict[str, object], message: str) -> None:
    """Subject, what was found, what was expected."""
    with pytest.raises(UsageError, match=f"^{message}$"):
        on_policy("modern", "a2s", overrides)


def test_steps_that_no_message_can_hold_are_refused() -> None:
    """An actor would wait for its welcome without end."""
    expected = "a whole number from 0 to 1000000000"
    with pytest.raises(UsageError, match=f"^short_steps: found 1{'0' * 19}, expected {expected}$"):
        off_policy("modern", {"short_steps": "1e19"})


def test_the_authors_have_few_settings() -> None:
    """The others are told apart: of another preset, or of none."""
    with pytest.raises(UsageError, match=r"'clip_ratio' \(only with --preset modern\)"):
        on_policy("authors", "a2s", {"clip_ratio": 0.1})
    with pytest.raises(UsageError, match=r"'fit_steps' \(removed: a constant of the presets"):
        on_policy("paper", "a2s", {"fit_steps": 50})


def test_a_preset_of_the_other_variant_names_that() -> None:
    with pytest.raises(UsageError, match=r"'sac' \(only with --variant off-policy\)"):
        on_policy("sac", "a2s", {})
    with pytest.raises(UsageError, match=r"'authors' \(only on-policy\)"):
        off_policy("authors", {})


def test_an_unknown_preset_names_the_nearest() -> None:
    """As for hyperparameters."""
    with pytest.raises(UsageError, match=r"unknown preset 'moden' \(did you mean 'modern'\?\)"):
        on_policy("moden", "a2s", {})
    with pytest.raises(UsageError, match=r"unknown preset 'moderm' \(did you mean 'modern'\?\)"):
        off_policy("moderm", {})


def test_a2c_refuses_several_suggestions() -> None:
    """They would contradict each other silently."""
    with pytest.raises(UsageError, match="suggestions: found 4, expected 1 with algo a2c"):
        on_policy("modern", "a2c", {"suggestions": "4"})


def test_a2c_may_have_the_stabiliser() -> None:
    """Section 6 of the paper: most of them are compatible with A2C."""
    assert on_policy("modern", "a2c", {"recovery": "invariant"}).recovery == "invariant"


def test_values_are_parsed_alike_from_text_and_file() -> None:
    """Every default survives being printed."""
    values = asdict(OnPolicyConfig())
    assert OnPolicyConfig.parse({name: str(value) for name, value in values.items()}) == values


def test_batches_grow_from_the_first_to_the_last_size() -> None:
    """By 1.5: 512, 768, 1152, 1728, then the last."""
    hyper = OnPolicyConfig(batch_steps=2048, first_batch_steps=512, batch_growth=1.5)
    assert [hyper.batch_steps_at(update) for update in range(5)] == [512, 768, 1152, 1728, 2048]
    assert hyper.batch_steps_at(10**9) == 2048


def test_sac_is_modern_with_one_suggestion_one_value_and_plain_networks() -> None:
    """The same sizes and rates of the networks, observations normalised; its own discount."""
    sac, modern = off_policy("sac", {}), off_policy("modern", {})
    differ = {name for name, value in asdict(sac).items() if value != getattr(modern, name)}
    assert differ == {
        "act_suggestions", "num_quantiles", "quantiles_to_drop", "network", "tau",
        "average_updates", "short_steps", "policy_every",
        "selection", "norm_return", "kappa", "initial_temperature",
        "temperature_learning_rate", "gamma",
    }  # fmt: skip
    assert (sac.num_quantiles, sac.network) == (1, "mlp")
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


@pytest.mark.parametrize(
    ("vendor", "flags", "expected"),
    [
        ("GenuineIntel", "avx512f avx512_bf16 amx_bf16 amx_tile", "bf16"),
        ("GenuineIntel", "avx512f avx512_bf16", "f32"),
        ("AuthenticAMD", "avx512f avx512_bf16", "bf16"),
        ("AuthenticAMD", "avx512f", "f32"),
    ],
)
def test_matrix_products_are_in_bf16_where_that_is_faster(
    vendor: str, flags: str, expected: str
) -> None:
    """Measured: with Intel's vectors products take nearly twice as long as in float32."""
    assert fastest_precision(f"vendor_id\t: {vendor}\nflags\t\t: fpu {flags}\n") == expected


def test_a_precision_that_is_set_stays() -> None:
    assert off_policy("modern", {}).precision in ("bf16", "f32")
    assert off_policy("modern", {"precision": "f32"}).precision == "f32"
    assert off_policy("modern", {"precision": "bf16"}).precision == "bf16"


def test_paper_has_neither_entropy_nor_target_networks() -> None:
    """Algorithm 2 as printed, N x K suggestions, one Q."""
    paper = off_policy("paper", {})
    assert paper.initial_temperature == paper.temperature_learning_rate == 0
    assert (paper.tau, paper.num_critics, paper.policy_loss) == (1.0, 1, "score")
    assert (paper.target_suggestions, paper.gamma) == (10, 0.97)
    assert paper.target_groups > 1


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
        ({"precision": "f16"}, "precision: found 'f16', expected one of fastest, f32, bf16"),
        (
            {"replay_rows": 10**18},
            r"replay_rows: found 10+, expected a whole number from 1 to 1000000000",
        ),
        ({"replay_rows": 9}, r"batch_rows: found 256, expected at most replay_rows \(9\)"),
        (
            {"send_every_steps": 300, "lead_steps": 300, "replay_rows": 256},
            r"send_every_steps: found 300, expected at most replay_rows \(256\)",
        ),
        ({"priority_exponent": 1.5}, "priority_exponent: found 1.5, expected a number from 0 to 1"),
        ({"lead_steps": 1}, r"send_every_steps: found \d+, expected at most lead_steps \(1\)"),
        (
            {"num_quantiles": 5, "quantiles_to_drop": 5},
            r"quantiles_to_drop: found 5, expected fewer than num_quantiles \(5\)",
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
def test_wrong_off_policy_values_are_refused_in_one_line(
    overrides: dict[str, object], message: str
) -> None:
    """Subject, what was found, what was expected."""
    with pytest.raises(UsageError, match=f"^{message}$"):
        off_policy("modern", overrides)


def test_no_temperature_is_needed_where_nothing_is_drawn_among() -> None:
    """With one suggestion ``soft`` and ``hard`` are the same."""
    without = {"initial_temperature": 0, "temperature_learning_rate": 0}
    assert off_policy("modern", without | {"act_suggestions": 1}).initial_temperature == 0
