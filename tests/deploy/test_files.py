"""Container files: what they name exists, and they agree with the program and with each other."""

from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml

from a2s.cli import app


@pytest.fixture
def services(root: Path) -> Any:
    """The services of the compose file."""
    return yaml.safe_load((root / "deploy/compose.yaml").read_text())["services"]


@pytest.fixture
def jobs(root: Path) -> dict[str, Any]:
    """What Prometheus scrapes, by job."""
    config = yaml.safe_load((root / "deploy/prometheus/prometheus.yml").read_text())
    return {job["job_name"]: job for job in config["scrape_configs"]}


def option(command: list[str], name: str) -> str:
    """The value of ``--name=value``."""
    (value,) = (word.split("=", 1)[1] for word in command if word.startswith(f"--{name}="))
    return value


def test_what_the_image_copies_exists_and_is_sent_to_the_builder(root: Path) -> None:
    """``.dockerignore`` lets through what is copied, and only that."""
    lines = (root / "deploy/docker/Dockerfile").read_text().splitlines()
    copies = [line.split()[1:-1] for line in lines if line.startswith("COPY ")]
    copied = {source for copy in copies if not copy[0].startswith("--from") for source in copy}
    ignore = (root / ".dockerignore").read_text().splitlines()
    assert "*" in ignore
    assert {line[1:] for line in ignore if line.startswith("!")} == copied
    assert [source for source in copied if not (root / source).exists()] == []
    assert {"actors", "learner", "protocol", "src"} <= copied


def test_nothing_is_published_beyond_this_machine(services: Any) -> None:
    """The learner listens --insecure, and Grafana has no password worth the name."""
    assert set(services) == {"learner", "actor", "prometheus", "grafana"}
    for name, service in services.items():
        assert "network_mode" not in service, name
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), f"{name}: {port}"


@pytest.mark.parametrize("name", ["learner", "actor"])
def test_a_service_says_what_the_command_understands(services: Any, name: str) -> None:
    """Options are parsed by the command itself; variables are those that its options name."""
    command, *options = services[name]["command"]
    assert command == name
    parser = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
    parser.make_context(command, list(options))
    known = {parameter.envvar for parameter in parser.params}
    assert set(services[name].get("environment", {})) <= known


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


def test_mounted_files_exist_where_they_are_looked_for(root: Path, services: Any) -> None:
    """A missing file would be mounted as an empty directory, and Grafana would show nothing."""
    volumes = [v for service in services.values() for v in service.get("volumes", [])]
    ours = [volume for volume in volumes if volume.startswith(".")]
    assert [v for v in ours if not (root / "deploy" / v.split(":")[0]).exists()] == []
    assert [v for v in ours if not v.endswith(":ro")] == []
    provisioning = root / "deploy/grafana/provisioning"
    source = yaml.safe_load((provisioning / "datasources/prometheus.yml").read_text())
    assert source["datasources"][0]["url"] == "http://prometheus:9090"
    provider = yaml.safe_load((provisioning / "dashboards/a2s.yml").read_text())
    folder = provider["providers"][0]["options"]["path"]
    assert f"./grafana/dashboards:{folder}:ro" in services["grafana"]["volumes"]
    home = services["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert home == f"{folder}/a2s-run.json"
