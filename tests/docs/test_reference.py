"""The pages of reference against the code, where no generator writes them."""

import json
import re
from dataclasses import MISSING, fields

import doc_pages
from typer.main import get_command

from a2s import cli
from a2s.learner.run import directory
from a2s.learner.run.run_config import RunConfig

DOCS = doc_pages.ROOT / "docs"


def _shown(default: object) -> str:
    if isinstance(default, float):
        return repr(default)
    return json.dumps(list(default) if isinstance(default, tuple) else default)


def test_the_table_of_a_run_has_its_keys_and_defaults_in_their_order() -> None:
    table = doc_pages.rows((DOCS / "configuration.md").read_text())
    found = [(key.strip("`"), default) for key, default, _, meaning in table if meaning]
    assert found == [(each.name, _shown(each.default)) for each in fields(RunConfig)]
    assert all(each.default is not MISSING for each in fields(RunConfig))


def test_every_option_in_that_table_is_one_of_the_learner() -> None:
    learner = get_command(cli.app).commands["learner"]  # type: ignore[attr-defined]
    known = {name for each in learner.params for name in (*each.opts, *each.secondary_opts)}
    for _, _, options, _ in doc_pages.rows((DOCS / "configuration.md").read_text()):
        assert set(re.findall(r"--[a-z-]+", options)) <= known


def test_the_columns_of_the_tables_of_a_run_are_those_that_are_documented() -> None:
    files = {row[0]: row[1] for row in doc_pages.rows((DOCS / "run-directory.md").read_text())}
    assert ", ".join(directory.EPISODE_COLUMNS) in files["`episodes.csv`"]
    for column in ("wall_s", "env_steps", "weights_version", "mode", "episodes"):
        assert column in directory.EVALUATION_COLUMNS
        assert column in files["`evaluations.csv`"]
