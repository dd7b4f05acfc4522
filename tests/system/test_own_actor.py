"""docs/examples/robot_actor.py: an actor that was written from the page of the protocol alone."""

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from doc_pages import ROOT
from system_helpers import FAST, PATIENCE_S, Start

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(PATIENCE_S)]
EXAMPLES = ROOT / "docs/examples"
RUN = (*FAST, "--envs", "1", "--run-dir", "run", "--metrics-port", "-1", "--total-steps", "2000")


@pytest.fixture
def own_actor(tmp_path: Path, endpoint: str) -> Iterator["subprocess.Popen[bytes]"]:
    """The example, with what the learner has to know of its robot beside it."""
    shutil.copy(EXAMPLES / "robot.py", tmp_path)
    command = [sys.executable, str(EXAMPLES / "robot_actor.py"), endpoint]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE)
    yield process
    if process.poll() is None:
        process.kill()
    process.communicate()


@pytest.mark.long
def test_it_plays_for_a_learner_that_is_killed_and_resumed(
    own_actor: "subprocess.Popen[bytes]",
    start: Start,
    endpoint: str,
    tmp_path: Path,
    wait_for: Callable[..., None],
) -> None:
    """It joins the next learner, sends again what was not answered, and leaves when it is told."""
    first = start("learner", "--env", "./robot.py:Robot", "--listen", endpoint, *RUN)
    updates = tmp_path / "run/updates.csv"
    wait_for(lambda: updates.exists() and updates.read_text().count("\n") > 2, "an update", 60.0)
    assert f"join it     a2s actor --n 1 --connect {endpoint}" in first.text()
    first.end(signal.SIGKILL)
    second = start("learner", "--resume", "--listen", endpoint, *RUN)
    assert second.process.wait(PATIENCE_S) == 0, second.text()
    own_actor.send_signal(signal.SIGTERM)
    assert own_actor.wait(PATIENCE_S) == 0, own_actor.communicate()[1]

    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["finished"]
    assert summary["segments"]["refused"] == summary["segments"]["lost"] == 0
    events = map(json.loads, (tmp_path / "run/events.jsonl").read_text().splitlines())
    found = [each["event"] for each in events]
    assert [each for each in found if each != "again"] == ["start", "join", "start", "join", "end"]


@pytest.mark.parametrize(
    ("env_id", "wanted"),
    [
        ("/robot.py:Other", {}),
        ("/robot.py:Robot", {"frame_stack": 2}),
        ("/robot.py:Robot", {"kwargs": '{"port": 1}'}),
        ("/robot.py:Robot", {"wrappers": ["module:Class"]}),
    ],
)
def test_it_ends_where_it_cannot_play_what_is_wanted(
    env_id: str, wanted: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the limit of an episode, which it has."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import robot_actor

    with pytest.raises(SystemExit, match=f"not {env_id} with"):
        robot_actor.honoured({"env_id": env_id, "env": {"env_id": env_id, **wanted}})
    own = {"env_id": "/robot.py:Robot", "max_episode_steps": 7}
    assert robot_actor.honoured({"env": own}) == 7


def test_it_imports_nothing_of_a2s() -> None:
    for file in EXAMPLES.glob("*.py"):
        assert not re.search(r"^\s*(import|from) a2s\b", file.read_text(), re.MULTILINE)
