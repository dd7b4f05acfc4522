"""Names of other libraries lead to ours."""

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from a2s import cli
from a2s.learner.off_policy.config import OffPolicyConfig
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.run.aliases import OFF_POLICY, ON_POLICY, OPTIONS, REMOVED, RUN, meant
from a2s.learner.run.config import assemble, read
from a2s.learner.run.run_config import RunConfig
from a2s.protocol.errors import UsageError


@pytest.mark.parametrize(
    ("table", "settings"),
    [(ON_POLICY, OnPolicyConfig), (OFF_POLICY, OffPolicyConfig), (RUN, RunConfig)],
)
def test_every_name_leads_to_one_of_ours_and_is_none_itself(
    table: Mapping[str, str], settings: Any
) -> None:
    ours = {field.name for field in fields(settings)}
    assert set(table.values()) <= ours
    assert not set(table) & ours


def test_what_is_said_to_be_an_option_is_one() -> None:
    learner = get_command(cli.app).commands["learner"]  # type: ignore[attr-defined]
    options = {option for parameter in learner.params for option in parameter.opts}
    for name in (set(RUN) | set(OPTIONS)) - set(ON_POLICY) - set(OFF_POLICY):
        (option,) = meant(name, {}).strip(" ()").split()[-1:]
        assert option in options


def test_a_name_that_nobody_has_is_told_the_nearest() -> None:
    assert meant("gama", {"gamma", "tau"}) == " (did you mean 'gamma'?)"


@pytest.mark.parametrize(
    ("variant", "name", "said"),
    [
        ("on-policy", "polcy_sizes", "'policy_sizes'"),
        ("on-policy", "utd_rato", "'utd_ratio', only with --variant off-policy"),
        ("on-policy", "num_critic", "'num_critics', only with --variant off-policy"),
        ("on-policy", "epochs", "'policy_epochs', or 'critic_epochs'"),
        ("on-policy", "total_step", "the option --total-steps"),
        ("off-policy", "q_size", "'q_sizes', only on-policy"),
        ("off-policy", "hidden_sizes", "'policy_sizes', or 'critic_sizes'"),
        ("off-policy", "sugestions", "'act_suggestions'"),
    ],
)
def test_a_mistyped_name_is_told_the_likeliest_wherever_it_is(
    variant: str, name: str, said: str
) -> None:
    """The right one before names that are merely similar and happen to be valid here."""
    with pytest.raises(UsageError) as refused:
        assemble({"variant": variant}, {name: "1"})
    assert str(refused.value) == f"unknown hyperparameter {name!r} (did you mean {said}?)"


@pytest.mark.parametrize(
    ("options", "name", "said"),
    [
        ({}, "updates_per_step", "only with --variant off-policy: 'utd_ratio'"),
        ({}, "replay_rows", "only with --variant off-policy"),
        ({"preset": "authors"}, "normalise_obs", "only with --preset modern: 'norm_obs'"),
        ({}, "recovery_offset", "only in the presets authors and paper"),
        ({"variant": "off-policy"}, "clip_range", "only on-policy: 'clip_ratio'"),
        ({"variant": "off-policy"}, "suggestions", "here it is 'act_suggestions'"),
    ],
)
def test_a_name_of_elsewhere_is_told_where(options: dict[str, str], name: str, said: str) -> None:
    with pytest.raises(UsageError, match=f"^unknown hyperparameter '{name}' \\({said}\\)$"):
        assemble(options, {name: "1"})


@pytest.mark.parametrize(
    ("variant", "name"), [(variant, name) for variant, gone in REMOVED.items() for name in gone]
)
def test_a_name_that_is_gone_is_told_why(variant: str, name: str) -> None:
    reason = re.escape(REMOVED[variant][name].reason)
    said = rf"unknown hyperparameter '{name}' \((removed: )?{reason}\)"
    with pytest.raises(UsageError, match=f"^{said}$"):
        assemble({"variant": variant}, {name: "0.5"})


def test_a_file_may_have_what_is_gone_where_it_changed_nothing(tmp_path: Path) -> None:
    """With any other value it stays, to be refused, and where it still is a name."""
    file = tmp_path / "config.toml"
    values = "optimism = 0.0\nselection_fades = false\ndistil_top = 1\ndistil_weight = 0.2\n"
    file.write_text(f"[run]\nvariant = 'off-policy'\n[hyper]\ntau = 0.5\n{values}")
    assert read(file)[1] == {"tau": 0.5, "distil_weight": 0.2}
    authors = "fit_steps = 100\nselection = 'hard'\ngamma = 0.9\nclip_ratio = 0.1"
    file.write_text(f"[run]\npreset = 'paper'\n[hyper]\n{authors}")
    assert read(file)[1] == {"gamma": 0.9, "clip_ratio": 0.1}
    file.write_text(f"[hyper]\n{values}critics = 1\ntarget_lambda = 0.9\n")
    assert read(file)[1] == {
        "optimism": 0.0, "selection_fades": False, "target_lambda": 0.9,
    }  # fmt: skip


def test_a_whole_file_of_before_a_setting_goes_on_without_it(tmp_path: Path) -> None:
    """Short episodes, a policy that learns less often; who names a few values has the newest."""
    file, written = tmp_path / "config.toml", assemble({"variant": "off-policy"}, {}).to_toml()
    file.write_text(written)
    assert read(file)[1]["short_steps"] == 200
    file.write_text(written.replace("policy_every = 2\n", ""))
    assert assemble(*read(file)).changed() == {"policy_every": 1}
    file.write_text(written.replace("short_steps = 200\n", "").replace("policy_every = 2\n", ""))
    assert assemble(*read(file)).changed() == {"short_steps": 0, "policy_every": 1}
    file.write_text("[run]\nvariant = 'off-policy'\n[hyper]\ntau = 0.5\n")
    assert assemble(*read(file)).changed() == {"tau": 0.5}
