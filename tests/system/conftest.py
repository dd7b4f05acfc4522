"""Real processes, started and ended by their handles."""

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from system_helpers import PATIENCE_S, Command, Start


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start ``a2s`` with these arguments in ``tmp_path``; whatever still runs is ended."""
    commands: list[Command] = []

    def begin(*arguments: str) -> Command:
        log = tmp_path / f"{arguments[0]}-{len(commands)}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "a2s.cli", *arguments],
                cwd=tmp_path,
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        commands.append(Command(process, log))
        return commands[-1]

    yield begin
    for command in commands:
        if command.process.poll() is None:
            command.process.kill()
            command.process.wait()


@pytest.fixture
def run_a2s(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Run ``a2s ... --json`` to its end and give the object of its last line."""

    def run(*arguments: str) -> dict[str, Any]:
        done = subprocess.run(
            [sys.executable, "-m", "a2s.cli", *arguments, "--json"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return found

    return run


@pytest.fixture
def endpoint() -> str:
    """An endpoint that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
