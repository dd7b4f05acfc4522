"""An exported policy works without a2s, and returns what a2s evaluates."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from a2s.commands.export import export_run
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import UsageError

MakeGraph = Callable[..., bytes]
PLUGIN = Path(__file__).parents[1] / "plugin"
COUNT = "a2s_test_envs:Count-v0"
OWN = """
import gymnasium
import numpy as np

class Own(gymnasium.Env):
    observation_space = gymnasium.spaces.Dict(
        {"x": gymnasium.spaces.Box(-9, 9, (1,)), "y": gymnasium.spaces.Box(-9, 9, (1,))})
    action_space = gymnasium.spaces.Box(-1, 1, (2, 1))

    def __init__(self, start=0.0, port=0):
        assert port == 0
        self.start = start

    def reset(self, seed=None, options=None):
        self.count = self.start
        return {"x": [self.count], "y": [0.0]}, {}

    def step(self, action):
        assert action.shape == (2, 1)
        self.count += 1
        return {"x": [self.count], "y": [0.0]}, self.count, False, False, {}

class Twice(gymnasium.Wrapper):
    def step(self, action):
        obs, reward, *ends = self.env.step(action)
        return obs, 2 * reward, *ends
"""


def _export(tmp_path: Path, graph: bytes) -> Path:
    (tmp_path / "policy.onnx").write_bytes(graph)
    files = export_run(tmp_path / "policy.onnx", tmp_path / "out", "latest")
    named = {file.name for file in files}
    assert named >= {"README.md", "act.mjs", "policy.onnx", "rollout.py"}
    assert named == {file.name for file in (tmp_path / "out").iterdir()}
    return tmp_path / "out"


def _rollout(folder: Path) -> str:
    """What the program prints, in a Python that has no a2s."""
    (folder / "no_a2s.py").write_text("import sys; sys.modules['a2s'] = None; import rollout")
    done = subprocess.run(
        [sys.executable, "out/no_a2s.py"], cwd=folder.parent, capture_output=True, text=True,
        env={"PYTHONPATH": str(PLUGIN)}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_python_program_plays_an_episode(tmp_path: Path, make_graph: MakeGraph) -> None:
    """Rewards of 1 to 5 in five steps."""
    folder = _export(tmp_path, make_graph(metadata={"env": COUNT}))
    assert _rollout(folder) == "return 15.0"


def test_the_environment_is_made_as_the_run_made_it(tmp_path: Path, make_graph: MakeGraph) -> None:
    """A class of a file, its arguments, wrappers, a limit, repeated actions, stacked rows.

    It starts at 10 and goes on for six steps: (11 + ... + 16) doubled twice.
    """
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "more.py").write_text("from own import Twice")
    config = EnvConfig(
        env_id=f"{tmp_path / 'own.py'}:Own", kwargs='{"start": 10.0, "port": "{worker}"}',
        wrappers=("own:Twice", f"{tmp_path / 'more.py'}:Twice"),
        action_repeat=3, frame_stack=2, max_episode_steps=6,
    )  # fmt: skip
    told = {"env": config.env_id, "environment": config.to_json(), "obs_offset": "[5.0, 0, 5.0, 0]"}
    graph = make_graph(obs_size=4, low=(-1.0,) * 2, high=(1.0,) * 2, metadata=told)
    folder = _export(tmp_path, graph)
    for name in ("own.py", "more.py"):
        (tmp_path / name).unlink()  # it has its own copy
    assert _rollout(folder) == "return 324.0"
    assert "# Own\n" in (folder / "README.md").read_text()
    assert str(tmp_path) not in (folder / "README.md").read_text()
    assert "const offset = [5.0, 0, 5.0, 0];" in (folder / "act.mjs").read_text()


def test_the_card_says_what_is_known_of_the_run(tmp_path: Path, make_graph: MakeGraph) -> None:
    run = tmp_path / "run"
    (run / "latest").mkdir(parents=True)
    (run / "latest" / "policy.onnx").write_bytes(make_graph(metadata={"env": "Hopper-v5"}))
    summary: dict[str, Any] = {
        "variant": "on-policy", "algo": "a2s", "preset": "modern", "seed": 3, "env_steps": 1000,
        "wall_s": 7.0, "evaluation": {"mean": 3000.5, "std": 12.0, "episodes": 10, "mode": "mean"},
    }  # fmt: skip
    (run / "summary.json").write_text(json.dumps(summary))
    export_run(run, tmp_path / "out", "latest")
    card = (tmp_path / "out" / "README.md").read_text()
    front = yaml.safe_load(card.split("---")[1])
    assert front["tags"][:2] == ["Hopper-v5", "reinforcement-learning"]
    (metric,) = front["model-index"][0]["results"][0]["metrics"]
    assert metric == {"type": "mean_reward", "value": "3000.50 +/- 12.00", "name": "mean_reward"}
    assert "Return of 10 fresh episodes, mean action: 3000.5 ± 12.0." in card
    (run / "summary.json").write_text('{"evaluation": {"mean": 1}}')
    export_run(run, tmp_path / "other", "latest")
    assert "mean_reward" not in (tmp_path / "other" / "README.md").read_text()
    with pytest.raises(UsageError, match="out exists; name a new folder"):
        export_run(run, tmp_path / "out", "latest")


def test_the_card_says_nothing_of_other_weights(tmp_path: Path, make_graph: MakeGraph) -> None:
    """The evaluation of ``a2s train --weights best``, and a run that has gone on since."""
    graph, run = make_graph(metadata={"env": "Hopper-v5"}), tmp_path / "run"
    for weights in ("latest", "best"):
        (run / weights).mkdir(parents=True)
        (run / weights / "policy.onnx").write_bytes(graph)
    summary: dict[str, Any] = {
        "variant": "on-policy", "algo": "a2s", "preset": "modern", "seed": 3, "env_steps": 1000,
        "wall_s": 7.0, "weights_sha256": hashlib.sha256(graph).hexdigest(),
        "evaluation": {"mean": 1.0, "std": 0, "episodes": 9, "mode": "mean", "weights": "best"},
    }  # fmt: skip
    (run / "summary.json").write_text(json.dumps(summary))
    cards = []
    for name, weights in (("a", "best"), ("b", "latest"), ("c", "best")):
        export_run(run, tmp_path / name, weights)
        cards.append((tmp_path / name / "README.md").read_text())
        if name == "b":
            (run / "latest" / "policy.onnx").write_bytes(make_graph(metadata={"env": "Other-v5"}))
    assert ["of 9 fresh episodes" in card for card in cards] == [True, False, False]
    assert ["for 1,000 steps" in card for card in cards] == [True, True, False]


def test_a_file_that_is_called_as_another_of_the_folder_is_refused(
    tmp_path: Path, make_graph: MakeGraph
) -> None:
    (tmp_path / "rollout.py").write_text(OWN)
    told = {"env": f"{tmp_path / 'rollout.py'}:Own"}
    (tmp_path / "policy.onnx").write_bytes(make_graph(metadata=told))
    with pytest.raises(UsageError, match=r"found two files for rollout.py of the folder"):
        export_run(tmp_path / "policy.onnx", tmp_path / "out", "latest")
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_gone_is_named(tmp_path: Path, make_graph: MakeGraph) -> None:
    """Nothing is written without it."""
    (tmp_path / "policy.onnx").write_bytes(make_graph(metadata={"env": "/nowhere/own.py:Own"}))
    with pytest.raises(UsageError, match=r"found no /nowhere/own.py, which its environment needs"):
        export_run(tmp_path / "policy.onnx", tmp_path / "out", "latest")
    assert not (tmp_path / "out").exists()
