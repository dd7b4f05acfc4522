"""Container files: what they name exists, and they agree with the program and with each other."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer.main
import yaml

from a2s.cli import app


class Stage(NamedTuple):
    """One stage of the Dockerfile."""

    base: str
    lines: list[str]

    def values(self, instruction: str) -> list[str]:
        """What follows each use of an instruction."""
        pairs = [line.split(maxsplit=1) for line in self.lines]
        return [rest for word, rest in pairs if word == instruction]

    @property
    def sources(self) -> list[str]:
        """Stages that it copies from."""
        return re.findall(r"--from=(\S+)", "\n".join(self.lines))


@pytest.fixture
def stages(root: Path) -> dict[str, Stage]:
    """The stages of the Dockerfile, without comments, one line an instruction."""
    text = (root / "deploy/docker/Dockerfile").read_text()
    code = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    found: dict[str, Stage] = {}
    lines: list[str] = []
    for line in filter(None, re.sub(r"\\\n\s*", " ", code).splitlines()):
        if named := re.fullmatch(r"FROM (\S+) AS (\S+)", line):
            lines = []
            found[named[2]] = Stage(named[1], lines)
        else:
            lines.append(line)
    return found


@pytest.fixture
def services(root: Path) -> Any:
    """The services of the compose file."""
    return yaml.safe_load((root / "deploy/compose.yaml").read_text())["services"]


@pytest.fixture
def jobs(root: Path) -> dict[str, Any]:
    """What Prometheus scrapes, by job."""
    config = yaml.safe_load((root / "deploy/prometheus/prometheus.yml").read_text())
    return {job["job_name"]: job for job in config["scrape_configs"]}


def behind(stages: dict[str, Stage], name: str) -> list[Stage]:
    """A stage and all that it is made from."""
    if name not in stages:
        return []
    stage = stages[name]
    return [stage, *(s for n in (stage.base, *stage.sources) for s in behind(stages, n))]


def option(command: list[str], name: str) -> str:
    """The value of ``--name=value``."""
    (value,) = (word.split("=", 1)[1] for word in command if word.startswith(f"--{name}="))
    return value


def test_the_images_of_actor_and_learner_differ_by_torch(stages: dict[str, Stage]) -> None:
    """The actor's image is a tenth of the learner's."""
    actor = "\n".join(line for stage in behind(stages, "actor") for line in stage.lines)
    assert "torch" not in actor.lower()
    assert "learner]" not in actor
    assert "[learner]" in "\n".join(stages["learner"].lines)
    assert stages["learner"].values("ARG") == ["TORCH_INDEX="]


def test_nothing_is_pulled_but_the_base(root: Path, stages: dict[str, Stage]) -> None:
    """So that any machine with one base image can build."""
    text = (root / "deploy/docker/Dockerfile").read_text()
    assert "ARG BASE=python:3.12-slim-bookworm\n" in text
    assert "syntax=" not in text
    for stage in stages.values():
        assert {stage.base, *stage.sources} <= {"${BASE}", *stages}


@pytest.mark.parametrize("target", ["actor", "learner"])
def test_an_image_runs_a2s_as_a_user_without_rights(stages: dict[str, Stage], target: str) -> None:
    """Stopped by the signal that a2s takes as a request for a clean stop."""
    runtime = stages["runtime"]
    assert stages[target].base == "runtime"
    assert stages[target].values("USER") == ["10001:10001"]
    assert stages[target].values("CMD") == [f'["{target}"]']
    assert runtime.values("ENTRYPOINT") == ['["a2s"]']
    assert runtime.values("STOPSIGNAL") == ["SIGTERM"]
    assert (runtime.values("VOLUME"), runtime.values("WORKDIR")) == (["/data"], ["/data"])


def test_what_is_copied_exists_and_is_sent_to_the_builder(
    root: Path, stages: dict[str, Stage]
) -> None:
    """``.dockerignore`` lets through what is copied, and only that."""
    copied = {
        source
        for stage in stages.values()
        for copy in stage.values("COPY")
        if not copy.startswith("--from")
        for source in copy.split()[:-1]
    }
    ignore = (root / ".dockerignore").read_text().splitlines()
    assert "*" in ignore
    assert {line[1:] for line in ignore if line.startswith("!")} == copied
    for source in copied:
        assert (root / source).exists(), source


def test_the_wheel_is_made_of_what_is_copied(root: Path, stages: dict[str, Stage]) -> None:
    """A new root package must come into the image too."""
    packed = re.search(r"targets\.wheel\]\nonly-include = \[(.*?)\]", _pyproject(root), re.DOTALL)
    assert packed is not None
    needed = {path.split("/")[0] for path in re.findall(r'"(.*?)"', packed[1])}
    copied = {word for copy in stages["wheel"].values("COPY") for word in copy.split()[:-1]}
    assert needed <= copied


def _pyproject(root: Path) -> str:
    return (root / "pyproject.toml").read_text()


def test_nothing_is_published_beyond_this_machine(services: Any) -> None:
    """The link has no encryption, and Grafana no password worth the name."""
    assert set(services) == {"learner", "actor", "prometheus", "grafana"}
    for name, service in services.items():
        assert "network_mode" not in service, name
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), f"{name}: {port}"


@pytest.mark.parametrize("name", ["learner", "actor"])
def test_a_service_says_what_the_command_understands(
    services: Any, stages: dict[str, Stage], name: str
) -> None:
    """Options are parsed by the command itself; variables are those that its options name."""
    service = services[name]
    assert service["build"]["target"] in stages
    (command, *options) = service["command"]
    assert command == name
    parser = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
    parser.make_context(command, list(options))
    known = {parameter.envvar for parameter in parser.params}
    assert set(service.get("environment", {})) <= known


def test_services_find_each_other(services: Any, jobs: dict[str, Any]) -> None:
    """Names and ports of compose, Prometheus and the commands are the same."""
    learner, actor = services["learner"]["command"], services["actor"]["command"]
    port = option(learner, "listen").rsplit(":", 1)[1]
    assert option(actor, "connect") == f"tcp/learner:{port}"
    (scraped,) = jobs["a2s-learner"]["static_configs"]
    assert scraped["targets"] == [f"learner:{option(learner, 'metrics-port')}"]
    (looked_up,) = jobs["a2s-actor"]["dns_sd_configs"]
    assert looked_up["names"] == ["actor"]
    assert str(looked_up["port"]) == option(actor, "metrics-port")
    for command in (learner, actor):
        assert option(command, "metrics-host") == "0.0.0.0"
    assert int(option(learner, "n")) == services["actor"]["scale"] * int(option(actor, "n"))


def test_all_targets_of_a_run_get_the_same_label(jobs: dict[str, Any]) -> None:
    """Rules compare what the learner and what the actors say of a run."""
    (learner,) = jobs["a2s-learner"]["static_configs"]
    (relabel,) = jobs["a2s-actor"]["relabel_configs"]
    assert relabel == {"target_label": "run", "replacement": learner["labels"]["run"]}
    assert jobs["a2s-learner"]["honor_labels"] is True


def test_mounted_files_exist(root: Path, services: Any) -> None:
    """A missing file would be mounted as an empty directory."""
    for name, service in services.items():
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            if source.startswith("."):
                assert (root / "deploy" / source).exists(), f"{name}: {source}"
                assert volume.endswith(":ro"), f"{name}: {source}"


def test_grafana_finds_data_source_and_dashboard(root: Path, services: Any) -> None:
    """Where the files are mounted is where they are looked for."""
    provisioning = root / "deploy/grafana/provisioning"
    source = yaml.safe_load((provisioning / "datasources/prometheus.yml").read_text())
    assert source["datasources"][0]["url"] == "http://prometheus:9090"
    provider = yaml.safe_load((provisioning / "dashboards/a2s.yml").read_text())
    folder = provider["providers"][0]["options"]["path"]
    grafana = services["grafana"]
    assert f"./grafana/dashboards:{folder}:ro" in grafana["volumes"]
    home = grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert home == f"{folder}/a2s-run.json"
    assert (root / "deploy/grafana/dashboards/a2s-run.json").exists()
