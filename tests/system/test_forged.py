"""Notices that anybody puts, while a run goes on over real zenoh."""

import json
import subprocess
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from system_helpers import FAST, REACH, Command, Start

from a2s.protocol.codec import decode, encode
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Notice
from a2s.protocol.zenoh_bus import ZenohBus

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]


def _has_ended(command: Command, timeout_s: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        command.process.wait(timeout_s)
    return command.process.returncode is not None


@pytest.mark.long
def test_forged_notices_change_nothing(start: Start, endpoint: str, tmp_path: Path) -> None:
    """No quota is cut, played twice or left unfinished: a version has one batch of 256 steps."""
    path, keys, sent = tmp_path / "run", Keys("default"), 0
    learner = start(
        "learner", *REACH, *FAST, "--listen", endpoint, "--run-dir", str(path),
        "--metrics-port", "-1", "--total-steps", "1024",
    )  # fmt: skip
    start("actor", "--connect", endpoint, "--metrics-port", "-1")
    with closing(ZenohBus.connect(endpoint, lambda: True)) as bus:
        while not _has_ended(learner, 0.05):
            if answer := bus.ask(keys.notice, b"", 1.0):
                told = decode(answer, Notice)
                for forged in (
                    replace(told, generation=1 << 62),
                    replace(told, version=told.version + 1, epoch=1),
                    replace(told, version=told.version + 3),
                ):
                    bus.publish(keys.notice, encode(forged))
                    sent += 1
    assert learner.process.returncode == 0, learner.text()
    assert sent > 9
    summary = json.loads((path / "summary.json").read_text())
    assert (summary["env_steps"], summary["updates"]) == (1024, 4)
    assert summary["segments"]["accepted"] == summary["segments"]["sent"]
