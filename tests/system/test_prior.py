"""Prior data as a user gives them: import, learner, actor, stop and resume as real processes."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from segments import segment
from system_helpers import OFF_POLICY, REACH, rows
from typer.testing import CliRunner

from a2s.cli import app
from a2s.learner.replay import directory
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Spaces

pytestmark = [pytest.mark.system, pytest.mark.timeout(240)]

RunA2S = Callable[..., dict[str, Any]]
SMALL = (
    *REACH, *OFF_POLICY, "--lockstep", "--n", "1", "--seed", "3", "--set", "warm_up_steps=50",
    "--metrics-port", "-1", "--episodes", "1",
)  # fmt: skip
_SPACES = Spaces(obs_size=1, action_low=-np.ones(1, np.float32), action_high=np.ones(1, np.float32))


def _reached(path: Path) -> None:
    """A run's replay of episodes of Reach, all actions of which are right."""
    replay = directory.create(path / "replay", REACH[1], _SPACES, 800)
    for seq in range(100):
        replay.insert(
            segment(
                seq, 8, obs_size=1, obs=np.zeros((8, 1), np.float32), truncated=True,
                suggestion=np.full((8, 1), 0.6, np.float32),
            )
        )  # fmt: skip
    replay.close()


@pytest.mark.long
def test_from_import_to_resume(
    run_a2s: RunA2S, endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Updates follow own steps alone; a run that is resumed needs the prior data that it had."""
    _reached(tmp_path / "good")
    found = run_a2s("replay", "import", "good", "-o", "prior", "--limit", "500")
    assert (found["transitions"], found["env"]) == (500, REACH[1])
    summary = run_a2s("train", *SMALL, "--prior", "prior", "--total-steps", "200", "--run-dir", "r")
    due = summary["env_steps"] - 50
    assert due <= summary["updates"] <= due + 16  # lead_steps
    assert directory.look_at(tmp_path / "r" / "replay").live.stop == summary["env_steps"]
    config = (tmp_path / "r" / "config.toml").read_text()
    assert f'prior = "{tmp_path / "prior"}"\nprior_share = 0.5\n' in config
    shutil.move(tmp_path / "prior", tmp_path / "moved")
    learner = ("learner", "--resume", "--run-dir", "r", "--listen", endpoint)
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(app, [*learner, "--metrics-port", "-1"])
    assert isinstance(refused.exception, RunDirectoryError)
    assert f"prior data {tmp_path / 'prior'}: found no replay.json" in str(refused.exception)
    again = ("--resume", "--run-dir", "r", "--prior", "moved", "--total-steps", "300")
    summary = run_a2s("train", *again, "--metrics-port", "-1", "--episodes", "1")
    assert (summary["finished"], summary["segments"]["refused"]) == (True, 0)
    assert due + 80 <= summary["updates"] <= summary["env_steps"] - 50 + 16
    updates = rows(tmp_path / "r" / "updates.csv", without="wall_s")
    assert updates[-1].split(",")[0] == str(summary["updates"])
