"""What is deployed, as data."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

ROOT = Path(__file__).parents[2]


class Documented(NamedTuple):
    """One row of docs/metrics.md."""

    kind: str
    labels: frozenset[str]


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def dashboard() -> Any:
    """The dashboard as Grafana reads it."""
    return json.loads((ROOT / "deploy/grafana/dashboards/a2s-run.json").read_text())


@pytest.fixture(scope="session")
def rules() -> list[dict[str, Any]]:
    """Every recording and alerting rule."""
    text = (ROOT / "deploy/prometheus/a2s.rules.yml").read_text()
    return [rule for group in yaml.safe_load(text)["groups"] for rule in group["rules"]]


@pytest.fixture(scope="session")
def documented() -> dict[str, Documented]:
    """The metrics of docs/metrics.md, by name."""
    return dict(_rows((ROOT / "docs/metrics.md").read_text()))


def _rows(text: str) -> Iterator[tuple[str, Documented]]:
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        name = re.fullmatch(r"`(\w+)`", cells[0])
        if name and len(cells) == 5:
            yield name[1], Documented(cells[1], frozenset(re.findall(r"`(\w+)`", cells[2])))
