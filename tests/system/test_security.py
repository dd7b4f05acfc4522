"""Runs of real processes that let only known peers in."""

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import psutil
import pytest
from secured import free_port
from system_helpers import FAST, PATIENCE_S, REACH, Command, Start

from a2s.commands.certs import make
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.zenoh_bus import ZenohBus

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
SECRET = "only-a-test-knows-this"


@pytest.fixture
def certs(tmp_path: Path) -> Path:
    list(make(tmp_path / "certs", [], ["lab1"], [], 90))
    return tmp_path / "certs"


def actors(path: Path) -> set[str]:
    """The names of those who joined, without what is new for every process."""
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    return {each["actor"].partition(".")[0] for each in events if each["event"] == "join"}


def test_an_actor_that_is_refused_ends_with_one_line(start: Start, certs: Path) -> None:
    """It does not try for ever: nothing would change."""
    own, port = Security(tls=str(certs)), free_port()
    endpoint = f"tls/127.0.0.1:{port}"
    with closing(ZenohBus.listen(endpoint, own.listener(Keys("default"), endpoint))):
        actor = start("actor", "--connect", f"tcp/127.0.0.1:{port}", "--metrics-port", "-1")
        assert actor.process.wait(PATIENCE_S) == 1
    assert actor.text().splitlines()[-1] == (
        f"a2s: tcp/127.0.0.1:{port}: what listens there wants a certificate; "
        "name the folder of one with --tls DIR"
    )


@pytest.mark.long
def test_a_run_with_certificates_trains_and_shows_itself_to_those_who_have_one(
    start: Start, certs: Path, tmp_path: Path, wait_for: WaitFor
) -> None:
    """`a2s learner`, and actors of two certificates; `a2s status` of a viewer, and of nobody."""
    path, port = tmp_path / "run", free_port()
    learner = start(
        "learner", *REACH, *FAST, "--run-dir", str(path), "--total-steps", "4000", "--n", "2",
        "--listen", f"tcp/127.0.0.1:{port}", "--metrics-port", "-1", "--tls", "certs",
    )  # fmt: skip
    wait_for(lambda: "join it" in learner.text(), "the learner")
    assert f"a2s actor --n 2 --connect tls/127.0.0.1:{port} --tls certs\n" in learner.text()
    viewer = start("status", str(path), "--tls", "certs/viewer")
    assert viewer.process.wait(PATIENCE_S) == 0, viewer.text()
    assert "0 of 4,000 steps" in viewer.text()
    stranger = start("status", "--connect", f"tcp/127.0.0.1:{port}")
    assert stranger.process.wait(PATIENCE_S) == 1
    assert "wants a certificate" in stranger.text()
    for folder in ("certs", "certs/actor-lab1"):
        start(
            "actor", "--connect", f"tcp/127.0.0.1:{port}", "--tls", folder, "--metrics-port", "-1"
        )
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    assert json.loads((path / "summary.json").read_text())["env_steps"] >= 4000
    assert actors(path) == {"actor", "actor-lab1"}


@pytest.mark.long
def test_a_run_on_this_machine_trains_with_certificates(
    run_a2s: Callable[..., dict[str, object]], certs: Path, tmp_path: Path
) -> None:
    """`a2s train --tls`, with an evaluator."""
    summary = run_a2s(
        "train", *REACH, *FAST, "--run-dir", str(tmp_path / "run"), "--total-steps", "2000",
        "--tls", "certs", "--metrics-port", "-1", "--evaluate-every", "1000",
    )  # fmt: skip
    assert summary["finished"]
    assert actors(tmp_path / "run") == {"actor"}
    assert len((tmp_path / "run" / "evaluations.csv").read_text().splitlines()) > 1


@pytest.mark.long
def test_a_run_with_passwords_trains_and_shows_none(
    start: Start, tmp_path: Path, wait_for: WaitFor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On no command line, in no log and in no file of the run; actors take it from the variable."""
    (tmp_path / "users").write_text(f"actor:{SECRET}\nviewer:other\n")
    path, endpoint = tmp_path / "run", f"tcp/127.0.0.1:{free_port()}"
    learner = start(
        "learner", *REACH, *FAST, "--run-dir", str(path), "--total-steps", "4000", "--n", "2",
        "--listen", endpoint, "--metrics-port", "-1", "--password-file", "users",
    )  # fmt: skip
    monkeypatch.setenv("A2S_PASSWORD", f"actor:{SECRET}")
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "-1")
    wait_for(lambda: len(actor.workers()) == 2, "the workers")
    shown = [words(command) for command in (learner, actor)]
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    assert actors(path) == {"actor"}
    files = [file for file in path.rglob("*") if file.is_file()]
    shown += [file.read_bytes().decode(errors="replace") for file in files]
    shown += [learner.text(), actor.text()]
    assert not [text for text in shown if SECRET in text]


def words(command: Command) -> str:
    """The command lines of a command and all that it has started."""
    process = psutil.Process(command.process.pid)
    return "\n".join(
        " ".join(each.cmdline()) for each in (process, *process.children(recursive=True))
    )
