"""docs/algorithm.md is true: what it names exists, and it leaves nothing out."""

import ast
import dataclasses
import functools
import re
from pathlib import Path

import pytest

from a2s.learner import off_policy_presets, on_policy_learning
from a2s.learner.algorithm.hyperparameters import OnPolicyHyper
from a2s.learner.learner import POSITION
from a2s.learner.presets import PRESETS, Choice

REPO = Path(__file__).parents[2]
PAGE = REPO / "docs" / "algorithm.md"
FOLDER = REPO / "learner" / "algorithm"
HYPER = [field.name for field in dataclasses.fields(OnPolicyHyper)]
PRESET_ROW = re.compile(r"\| `(\w+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \| ([^|]+) \|")
# `file.py: name, Class.method`, also in the pseudo-code.
NAME = r"\w+(?:\.\w+)*"
REFERENCE = re.compile(rf"([\w/]+\.py): ({NAME}(?:, {NAME})*)")


def _sections() -> dict[str, str]:
    parts = re.split(r"^## (\d)\. .*$", PAGE.read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def _references() -> list[tuple[str, str]]:
    found = REFERENCE.findall(PAGE.read_text())
    return sorted({(file, name) for file, names in found for name in names.split(", ")})


def _file(name: str) -> Path:
    return REPO / name if "/" in name else FOLDER / name


@functools.cache
def _names(path: Path) -> set[str]:
    """What a module defines at its top, and in its classes as ``Class.name``."""
    module = ast.parse(path.read_text())
    found = _defined(module.body)
    for node in module.body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for name in _defined(node.body)}
    return found


def _defined(body: list[ast.stmt]) -> set[str]:
    found = set()
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def _cell(choice: Choice) -> str:
    value = choice.value
    if choice.source == "not used here":
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "-".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _first_column(section: str) -> list[str]:
    cells = [line.split(" | ")[0] for line in section.splitlines() if line.startswith("| `")]
    return [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]


def test_the_page_names_many_functions() -> None:
    """Else the tests below would pass on a page that they cannot read."""
    assert len(_references()) > 60
    assert len(re.findall(r"\w+\.py\b", PAGE.read_text())) >= len(_references()) * 3 // 4
    assert sorted(_sections()) == list("12345678")


@pytest.mark.parametrize(("file", "name"), _references())
def test_what_the_page_names_exists(file: str, name: str) -> None:
    """Classes, functions, methods and constants, each in its file."""
    assert name in _names(_file(file))


def test_files_that_the_page_names_exist() -> None:
    """Also those that it names without a function."""
    text = PAGE.read_text()
    for file in re.findall(r"[\w/]+\.py\b", text):
        assert _file(file).is_file(), file
    for page in re.findall(r"`(docs/[\w/-]+\.md)`", text):
        assert (REPO / page).is_file(), page


def test_no_file_of_the_algorithm_is_left_out() -> None:
    """Each has a place on the page, but for the one that explains itself below."""
    named = set(re.findall(r"\w+\.py\b", PAGE.read_text()))
    files = {path.name for path in FOLDER.glob("*.py")} - {"__init__.py", "hyperparameters.py"}
    assert files <= named


def test_every_hyperparameter_stands_with_its_values_in_the_presets() -> None:
    """In the order of the fields; a failure prints the rows as they should begin."""
    rows = [cells for *cells, _ in PRESET_ROW.findall(_sections()["4"])]
    expected = []
    for name in HYPER:
        modern, authors, paper = (
            _cell(PRESETS[preset][name]) for preset in ("modern", "authors", "paper")
        )
        same = "=" if authors == modern else authors, "=" if paper == authors else paper
        expected.append([name, modern, *same])
    wrong = [row for row in expected if row not in rows]
    assert wrong == []
    assert rows == expected


def test_every_off_policy_hyperparameter_stands_with_its_values_in_the_presets() -> None:
    """In the order of the fields; a failure prints the rows as they should begin."""
    rows = [cells for *cells, _ in PRESET_ROW.findall(_sections()["8"])]
    tables = [off_policy_presets.PRESETS[preset] for preset in ("modern", "sac", "paper")]
    expected = []
    for name in tables[0]:
        modern, *others = (_cell(table[name]) for table in tables)
        expected.append([name, modern, *("=" if each == modern else each for each in others)])
    assert [row for row in expected if row not in rows] == []
    assert rows == expected


def test_every_deviation_of_modern_from_the_paper_has_its_reason() -> None:
    """Whatever both use, with other values, stands in section 5."""
    given = re.findall(r"`(\w+)`", _sections()["5"])
    for name in HYPER:
        modern, paper = _cell(PRESETS["modern"][name]), _cell(PRESETS["paper"][name])
        if "-" not in (modern, paper) and modern != paper:
            assert name in given


def test_every_column_of_updates_csv_is_explained_once() -> None:
    """In the order of the file."""
    assert tuple(_first_column(_sections()["6"])) == (
        *POSITION,
        *on_policy_learning.COLUMNS,
    )


def test_lines_outside_tables_are_short() -> None:
    """At most 160 characters."""
    lines = PAGE.read_text().splitlines()
    assert [line for line in lines if len(line) > 160 and not line.startswith("|")] == []
