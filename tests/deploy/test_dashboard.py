"""The dashboard: as generated, readable, and of metrics that exist and are explained."""

import itertools
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser
import pytest
from prometheus_client.registry import Collector

from a2s.actors.metrics import Fleet
from a2s.learner.run.metrics import LearnerMetrics

DATASOURCE = {"type": "prometheus", "uid": "${datasource}"}
# How far the run has got is the value itself of a counter.
RAW_COUNTERS = {"Progress", "Time left"}


@pytest.fixture(scope="module")
def panels(dashboard: Any) -> list[Any]:
    """Every panel that shows something."""
    return [panel for panel in dashboard["panels"] if panel["type"] != "row"]


@pytest.fixture(scope="module")
def queries(panels: list[Any]) -> list[tuple[str, str]]:
    """Title and PromQL of every target, with Grafana's variables filled in."""
    return [
        (panel["title"], t["expr"].replace("$__rate_interval", "1m").replace("$run", ".*"))
        for panel in panels
        for t in panel["targets"]
    ]


def exported(collector: Collector) -> dict[str, str]:
    """Name and type of every metric, as Prometheus sees them."""
    suffix = {"counter": "_total", "info": "_info"}
    return {
        metric.name + suffix.get(metric.type, ""): metric.type.replace("info", "gauge")
        for metric in collector.collect()
    }


@pytest.fixture(scope="module")
def in_code() -> dict[str, str]:
    """Name and type of every metric of both roles."""
    return exported(LearnerMetrics().registry) | exported(Fleet(1).registry)


def selectors(expression: str) -> Iterator[tuple[promql_parser.VectorSelector, str]]:
    """Every selector of an expression, with the function that it is a range for, or ``""``."""
    seen: list[tuple[promql_parser.VectorSelector, str]] = []
    ranged: list[str] = []

    def visit(node: promql_parser.Expr) -> None:
        if isinstance(node, promql_parser.Call):
            ranges = [a for a in node.args if isinstance(a, promql_parser.MatrixSelector)]
            for matrix in ranges:
                seen.append((matrix.vector_selector, node.func.name))
                ranged.append(str(matrix.vector_selector))
        if isinstance(node, promql_parser.VectorSelector):
            if str(node) in ranged:
                ranged.remove(str(node))
            else:
                seen.append((node, ""))

    promql_parser.walk(promql_parser.parse(expression), visit)
    yield from seen


def metric_of(series: str, known: dict[str, str]) -> tuple[str, str]:
    """Name and type of the metric that a series belongs to; a part of a histogram is a counter."""
    base = re.sub(r"_(bucket|sum|count)$", "", series)
    if known.get(base) == "histogram":
        return base, "counter"
    return series, known.get(series, "unknown")


def test_the_generator_writes_the_committed_bytes(root: Path, tmp_path: Path) -> None:
    """Whoever changes one changes both."""
    copy = tmp_path / "build_dashboard.py"
    copy.write_text((root / "deploy/grafana/build_dashboard.py").read_text())
    (tmp_path / "dashboards").mkdir()
    subprocess.run([sys.executable, str(copy)], check=True, timeout=30)
    made = (tmp_path / "dashboards/a2s-run.json").read_bytes()
    assert made == (root / "deploy/grafana/dashboards/a2s-run.json").read_bytes()


def test_every_panel_says_what_it_shows(panels: list[Any]) -> None:
    """Title, description, unit, legend, and the data source that the user chooses."""
    for panel in panels:
        assert panel["description"].endswith("."), panel["title"]
        assert panel["fieldConfig"]["defaults"]["unit"], panel["title"]
        assert panel["datasource"] == DATASOURCE, panel["title"]
        assert panel["targets"], panel["title"]
        for target in panel["targets"]:
            assert target["datasource"] == DATASOURCE, panel["title"]
            assert target["legendFormat"], panel["title"]
            # A fixed range is empty at one scrape interval and blurred at another.
            assert {*re.findall(r"\[(.*?)\]", target["expr"])} <= {"$__rate_interval"}
        references = [target["refId"] for target in panel["targets"]]
        assert len({*references}) == len(references), panel["title"]


def test_panels_have_their_own_number_title_and_place(dashboard: Any) -> None:
    """24 columns, and no panel on top of another."""
    for key in ("id", "title"):
        twice = [x for x, n in Counter(p[key] for p in dashboard["panels"]).items() if n > 1]
        assert twice == []
    places = [(p["title"], p["gridPos"]) for p in dashboard["panels"]]
    assert [title for title, at in places if at["x"] < 0 or at["x"] + at["w"] > 24] == []
    for (title, a), (other, b) in itertools.combinations(places, 2):
        beside = a["x"] + a["w"] <= b["x"] or b["x"] + b["w"] <= a["x"]
        above = a["y"] + a["h"] <= b["y"] or b["y"] + b["h"] <= a["y"]
        assert beside or above, f"{title} overlaps {other}"


def test_one_dashboard_serves_any_data_source_and_any_run(
    dashboard: Any, queries: list[tuple[str, str]]
) -> None:
    """``All`` is ``.*``, which also matches where there is no label ``run``."""
    datasource, run = dashboard["templating"]["list"]
    assert (datasource["name"], datasource["type"]) == ("datasource", "datasource")
    assert (run["name"], run["multi"], run["allValue"]) == ("run", True, ".*")
    assert run["datasource"] == DATASOURCE
    for title, expression in queries:
        for selector, _ in selectors(expression):
            matchers = [(m.name, m.value) for m in selector.matchers.matchers]
            assert ("run", ".*") in matchers, f"{title}: {selector.name} is of any run"


def test_dashboard_and_rules_use_metrics_that_exist_and_counters_as_rates(
    queries: list[tuple[str, str]], in_code: dict[str, str], rules: list[dict[str, Any]]
) -> None:
    """A renamed metric would leave an empty panel or an alert that never fires.

    A counter falls to 0 with its process, and only ``rate`` and ``increase`` know that.
    """
    known = {"up", *in_code, *(rule["record"] for rule in rules if "record" in rule)}
    recorded = [(rule.get("alert", rule.get("record")), rule["expr"]) for rule in rules]
    for title, expression in [*queries, *recorded]:
        for selector, function in selectors(expression):
            assert selector.name is not None
            name, kind = metric_of(selector.name, in_code)
            assert name in known, f"{title}: there is no {selector.name}"
            if kind == "counter" and title not in RAW_COUNTERS:
                assert function in ("rate", "increase"), f"{title}: bare {selector.name}"
            if kind == "gauge":
                assert function not in ("rate", "increase"), f"{title}: rate of {selector.name}"


def test_every_metric_is_explained_and_every_explanation_has_a_metric(
    in_code: dict[str, str], documented: dict[str, Any]
) -> None:
    """With its type."""
    assert {name: row.kind for name, row in documented.items()} == in_code


def test_every_alert_says_what_is_wrong_and_is_in_the_manual(
    root: Path, rules: list[dict[str, Any]]
) -> None:
    """What to do about each is in docs/deploy.md."""
    manual = (root / "docs/deploy.md").read_text()
    alerts = {rule["alert"]: rule for rule in rules if "alert" in rule}
    assert set(re.findall(r"`(A2S[A-Z][a-z]\w+)`", manual)) == set(alerts)
    for alert in alerts.values():
        assert alert["labels"]["severity"] in ("warning", "critical")
        assert set(alert["annotations"]) == {"summary", "description"}
