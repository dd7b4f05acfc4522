"""Names of other libraries lead to ours."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import pytest
from typer.main import get_command

from a2s import cli
from a2s.learner.algorithm.hyperparameters import OnPolicyHyper
from a2s.learner.algorithm.off_policy_hyper import OffPolicyHyper
from a2s.learner.configuration import RunConfig
from a2s.learner.other_names import OFF_POLICY, ON_POLICY, RUN, meant


@pytest.mark.parametrize(
    ("table", "settings"),
    [(ON_POLICY, OnPolicyHyper), (OFF_POLICY, OffPolicyHyper), (RUN, RunConfig)],
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
    for name in set(RUN) - set(ON_POLICY) - set(OFF_POLICY):
        (option,) = meant(name, {}, ON_POLICY).strip(" ()").split()[-1:]
        assert option in options


def test_a_name_that_nobody_has_is_told_the_nearest() -> None:
    assert meant("gama", {"gamma", "tau"}, ON_POLICY) == " (did you mean 'gamma'?)"
