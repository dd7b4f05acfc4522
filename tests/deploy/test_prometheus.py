"""A real Prometheus scrapes a real run: every query of dashboard and rules has an answer."""

import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

T = TypeVar("T")
REQUIRE = "A2S_REQUIRE_PROMETHEUS"
# What a run in which nothing goes wrong does not show.
NO_DATA_EXPECTED = {
    "Refused messages": "no message of a healthy run is refused",
    "Transitions dropped by actors": "a healthy run drops none",
}
FAST = {"scrape_interval": "1s", "evaluation_interval": "1s"}


class Watched(NamedTuple):
    """A run and the Prometheus that scrapes it."""

    learner: str
    actor: str
    api: str

    def query(self, expression: str) -> list[dict[str, Any]]:
        """Ask for the present value of an expression."""
        answer = read(f"{self.api}/query?{urllib.parse.urlencode({'query': expression})}")
        result = json.loads(answer)["data"]["result"]
        assert isinstance(result, list)
        return result

    def shows(self, expression: str) -> bool:
        """Whether there is a number to show."""
        return shown(self.query(expression))


def read(url: str) -> str:
    """Read a page."""
    with urllib.request.urlopen(url, timeout=10) as page:
        return str(page.read().decode())


def until(look: Callable[[], T | None], what: str, timeout_s: float = 60.0) -> T:
    """Look until there is something to see."""
    deadline_s = time.monotonic() + timeout_s
    pause = threading.Event()
    while not (seen := look()):
        assert time.monotonic() < deadline_s, f"waited {timeout_s:.0f} s for {what}"
        pause.wait(0.2)
    return seen


def free_port() -> int:
    """Find a port of this machine on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def started(command: list[str], log: Path) -> Iterator[None]:
    """Run a program until the end of the block."""
    with (
        log.open("w") as out,
        subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=log.parent) as process,
    ):
        try:
            yield
        finally:
            process.terminate()


def serving(log: Path) -> str:
    """Where a command says that its metrics are."""
    return until(lambda: re.search(r"metrics +(http://\S+)", log.read_text()), f"port in {log}")[1]


def configuration(deployed: Path, targets: dict[str, str]) -> dict[str, Any]:
    """Change the deployed configuration in nothing but intervals and addresses."""
    config: dict[str, Any] = yaml.safe_load(deployed.read_text())
    config["global"] = FAST
    config["rule_files"] = [str(deployed.with_name(name)) for name in config["rule_files"]]
    for job in config["scrape_configs"]:
        (static,) = job.pop("static_configs", [{}])
        job.pop("dns_sd_configs", None)
        address = urllib.parse.urlsplit(targets[job["job_name"]]).netloc
        job["static_configs"] = [{**static, "targets": [address]}]
    return config


@pytest.fixture(scope="module")
def promtool() -> str:
    """Find Prometheus and its tool; the tool's path."""
    tool = shutil.which("promtool")
    if tool is None or shutil.which("prometheus") is None:
        reason = "prometheus and promtool are not installed (Debian: apt-get install prometheus)"
        if os.environ.get(REQUIRE) == "1":
            pytest.fail(f"{reason}, and {REQUIRE} is 1")
        pytest.skip(reason)
    return tool


@pytest.fixture(scope="module")
def watched(
    promtool: str, root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Watched]:
    """A run of two workers and an evaluator, watched with the deployed configuration."""
    folder = tmp_path_factory.mktemp("watched")
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    small = ["--set", "batch_steps=256", "--set", "first_batch_steps=256", "--envs", "2"]
    size = ["--env", "InvertedPendulum-v5", "--total-steps", "100000000", "--n", "2", *small]
    size += ["--evaluate-every", "256", "--evaluation-episodes", "1"]
    place = ["--listen", endpoint, "--run-dir", str(folder / "run")]
    config, server = folder / "prometheus.yml", f"127.0.0.1:{port}"
    commands = {"learner": [*size, *place], "actor": ["--n", "2", "--connect", endpoint]}
    with ExitStack() as stack:
        addresses = {}
        for name, options in commands.items():
            command = [sys.executable, "-m", "a2s.cli", name, "--run", "watched", *options]
            log = folder / f"{name}.log"
            stack.enter_context(started([*command, "--metrics-port", "0"], log))
            addresses[f"a2s-{name}"] = serving(log)
        evaluator = ["actor", "--evaluate", "--run", "watched", "--connect", endpoint]
        command = [sys.executable, "-m", "a2s.cli", *evaluator, "--metrics-port", "-1"]
        stack.enter_context(started(command, folder / "evaluator.log"))
        deployed = root / "deploy/prometheus/prometheus.yml"
        config.write_text(yaml.safe_dump(configuration(deployed, addresses)))
        subprocess.run([promtool, "check", "config", str(config)], check=True, timeout=30)
        files = [f"--config.file={config}", f"--storage.tsdb.path={folder / 'tsdb'}"]
        command = ["prometheus", *files, f"--web.listen-address={server}", "--log.level=warn"]
        stack.enter_context(started(command, folder / "prometheus.log"))
        learner, actor = addresses["a2s-learner"], addresses["a2s-actor"]
        watched = Watched(learner, actor, f"http://{server}/api/v1")

        def all_up() -> bool:
            with suppress(OSError):
                return [s["value"][1] for s in watched.query("up")] == ["1", "1"]
            return False

        until(all_up, "both targets to be up")
        yield watched


def shown(series: list[dict[str, Any]]) -> bool:
    """Whether a result has a number."""
    return any(math.isfinite(float(one["value"][1])) for one in series)


def test_every_query_of_the_dashboard_shows_something(watched: Watched, dashboard: Any) -> None:
    """A label or a name that is wrong, in one of more than fifty queries, is an empty panel."""
    queries = [
        (panel["title"], target["expr"], target["legendFormat"])
        for panel in dashboard["panels"]
        for target in panel.get("targets", [])
    ]
    assert set(NO_DATA_EXPECTED) <= {title for title, _, _ in queries}
    empty = {query for query in queries if query[0] not in NO_DATA_EXPECTED}

    def look() -> bool:
        for title, expression, legend in sorted(empty):
            filled = expression.replace("$__rate_interval", "10s").replace("$run", "default")
            series = watched.query(filled)
            if shown(series):
                empty.discard((title, expression, legend))
                labels = set(re.findall(r"{{(\w+)}}", legend))
                unknown = labels - set.intersection(*(set(one["metric"]) for one in series))
                assert not unknown, f"{title}: the legend names {unknown}"
        return not empty

    try:
        until(look, "every panel to show something", timeout_s=45.0)
    except AssertionError as error:
        raise AssertionError(f"{error}; empty: {sorted(empty)}") from None


def test_every_recording_rule_records_something(
    watched: Watched, rules: list[dict[str, Any]]
) -> None:
    """What it records, and what its expression says at the same time."""
    recording = [rule for rule in rules if "record" in rule]
    assert recording
    for rule in recording:
        for expression in (rule["expr"], rule["record"]):
            until(partial(watched.shows, expression), f"{rule['record']}: {expression}")
        assert {one["metric"]["run"] for one in watched.query(rule["record"])} == {"default"}


def test_no_rule_fails_and_no_alert_fires_in_a_healthy_run(
    watched: Watched, rules: list[dict[str, Any]]
) -> None:
    """An alert that cannot be evaluated is one that never fires."""

    def evaluated() -> list[dict[str, Any]]:
        groups = json.loads(read(f"{watched.api}/rules"))["data"]["groups"]
        found = [rule for group in groups for rule in group["rules"]]
        times = [datetime.fromisoformat(rule["lastEvaluation"]).timestamp() for rule in found]
        return found if min(times) > learned_s else []

    until(partial(watched.shows, "a2s_learner_loss"), "an update")
    learned_s = time.time()
    found = until(evaluated, "all rules to be evaluated")
    assert len(found) == len(rules)
    assert [rule["lastError"] for rule in found if rule["health"] != "ok"] == []
    assert [rule["name"] for rule in found if rule.get("state") == "firing"] == []


def test_the_learner_names_its_run_and_the_configuration_labels_the_rest(watched: Watched) -> None:
    """``honor_labels`` keeps the learner's own word in a2s_run_info, and only there."""
    (info,) = until(lambda: watched.query("a2s_run_info"), "a2s_run_info")
    assert info["metric"]["run"] == "watched"
    assert info["metric"]["env_id"] == "InvertedPendulum-v5"
    others = watched.query('{__name__=~"a2s_(learner|actor|build).*"}')
    assert {one["metric"].get("run") for one in others} == {"default"}
    # One target has all workers of an actor, whatever --n is.
    query = "count by (job, instance) (a2s_actor_worker_up == 1)"
    (target,) = until(lambda: watched.query(query), query)
    assert target["value"][1] == "2"


def test_what_is_served_is_as_promtool_and_the_manual_want_it(
    promtool: str, watched: Watched, documented: dict[str, Any]
) -> None:
    """Names, units, types, help texts, and the labels of every series of both targets."""
    for url in (watched.learner, watched.actor):
        served = read(url)
        check = subprocess.run(
            [promtool, "check", "metrics"], input=served, text=True, capture_output=True,
            timeout=30, check=False,
        )  # fmt: skip
        assert (check.returncode, check.stderr) == (0, ""), url
        for family in text_string_to_metric_families(served):
            for sample in family.samples:
                part = re.sub(r"_(bucket|sum|count)$", "", sample.name)
                row = documented[part if family.type == "histogram" else sample.name]
                assert set(sample.labels) - {"le"} == row.labels, sample.name


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", "config", "prometheus.yml"],
        ["check", "rules", "a2s.rules.yml"],
        ["test", "rules", "a2s.test.yml"],
    ],
    ids=lambda arguments: " ".join(arguments),
)
def test_promtool_accepts_the_files(promtool: str, root: Path, arguments: list[str]) -> None:
    """Configuration, rules, and the rules' own tests."""
    done = subprocess.run(
        [promtool, *arguments], cwd=root / "deploy/prometheus", capture_output=True, text=True,
        timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_alert_is_tried(root: Path, rules: list[dict[str, Any]]) -> None:
    """In the rules' own tests every alert fires at least once."""
    text = (root / "deploy/prometheus/a2s.test.yml").read_text()
    tried = {
        alert["alertname"]
        for test in yaml.safe_load(text)["tests"]
        for alert in test["alert_rule_test"]
        if alert["exp_alerts"]
    }
    assert tried == {rule["alert"] for rule in rules if "alert" in rule}
