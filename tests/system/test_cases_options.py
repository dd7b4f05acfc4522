"""What a user says of the environment is told to all, kept with the run, and used again."""

import json
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import onnx
import pytest
from case_runs import A2S, SMALL, a2s, evaluate, events, train
from system_helpers import FAST, PATIENCE_S, Start, metrics_port, scrape

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
RECORDER = "a2s_case_numbers:Recorder-v0"


def _made(notes: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in notes.read_text().splitlines()]


def _metadata(policy: Path) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load(policy).metadata_props}


def _obs_size(policy: Path) -> int:
    shape = onnx.load(policy).graph.input[0].type.tensor_type.shape
    return int(shape.dim[-1].dim_value)


def test_every_option_of_the_environment_reaches_every_environment(tmp_path: Path) -> None:
    """Also those of an evaluation afterwards, which is told nothing but the run."""
    notes = tmp_path / "made"
    options = (
        "--env-kwargs", f"notes={notes}", "--env-kwargs", "port=5{worker}{env_index}",
        "--env-kwargs", 'gains={"left": [1, 2.5]}', "--env-kwargs", "fast=true",
        "--env-kwargs", "name=left=right",
        "--wrapper", 'a2s_case_numbers:Shift={"times": 100.0}',
        "--wrapper", "a2s_case_numbers:Shift",
        "--action-repeat", "4", "--frame-stack", "3", "--max-episode-steps", "80",
    )  # fmt: skip
    trained = train(tmp_path, RECORDER, *options, *SMALL, "--n", "2")
    made = _made(notes)
    given = {"gains": {"left": [1, 2.5]}, "fast": True, "name": "left=right"}
    assert all({**m, **given} == m for m in made)
    places = {(m["A2S_WORKER"], m["A2S_ENV_INDEX"]): str(m["port"]) for m in made}
    assert {(w, e) for w in "01" for e in "01"} <= set(places)
    assert all(places[w, e] == f"5{w}{e}" for w in "01" for e in "01")
    # 80 steps of the environment, four of them to each of ours.
    assert {e["length"] for e in trained.episodes()} <= {"20", "80"}
    assert all(float(e["return"]) < -1000 for e in trained.episodes())  # 150 at most, times 100
    policy = trained.path / "latest" / "policy.onnx"
    assert _obs_size(policy) == 9
    about = json.loads(_metadata(policy)["environment"])
    assert RECORDER in str(about)
    run = tomllib.loads((trained.path / "config.toml").read_text())["run"]
    assert (run["action_repeat"], run["frame_stack"], run["max_episode_steps"]) == (4, 3, 80)
    assert run["wrappers"] == ['a2s_case_numbers:Shift={"times": 100.0}', "a2s_case_numbers:Shift"]
    assert "fast=true" in run["env_kwargs"]
    before = len(made)
    again = evaluate(tmp_path, "run", "--episodes", "2")
    assert again["mean"] == trained.summary["evaluation"]["mean"]
    alone = evaluate(tmp_path, str(policy), "--episodes", "2")
    assert alone["mean"] == again["mean"]
    assert all({**m, **given} == m for m in _made(notes)[before:])
    assert len(_made(notes)) >= before + 2


_HERE = """
import colorsys, os, tempfile
import helper_of_mine
from a2s_case_envs import Control, register

class Here(Control):
    def __init__(self, length=40):
        super().__init__(length=length)
        colorsys.rgb_to_hsv(0.1, 0.2, 0.3)
        os.chdir(tempfile.gettempdir())

register("Here", Here, length=helper_of_mine.LENGTH)
"""
_HELPER = "LENGTH = 50\n"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A working directory with an environment, and with names that hide those of others."""
    (tmp_path / "my_env.py").write_text(_HERE)
    (tmp_path / "helper_of_mine.py").write_text(_HELPER)
    for name in ("random", "logging", "numpy", "msgpack", "zenoh", "torch", "colorsys"):
        (tmp_path / f"{name}.py").write_text('raise RuntimeError("this is not yours")\n')
    return tmp_path


def test_an_environment_of_a_file_is_found_by_every_command(here: Path) -> None:
    trained = train(here, "./my_env.py:Here", *SMALL, "--total-steps", "512")
    assert {e["length"] for e in trained.episodes()} == {"40"}
    assert evaluate(here, "run", "--episodes", "2")["lengths"] == [40, 40]


@pytest.mark.parametrize(
    "env",
    [
        "my_env:Here",
        pytest.param("./my_env.py:Here-v0", marks=pytest.mark.long),
        pytest.param("a2s_case_envs:Control", marks=pytest.mark.long),
    ],
)
def test_an_environment_has_four_forms(here: Path, env: str) -> None:
    done = a2s("check", env, cwd=here)
    assert done.code == 0, done.err


@pytest.mark.long
def test_an_environment_of_the_working_directory_is_found_by_learner_actor_and_evaluation(
    start: Start, endpoint: str, here: Path
) -> None:
    """Each of them looks into its own."""
    options = ("--listen", endpoint, "--run-dir", "run", "--total-steps", "512", "--n", "1")
    learner = start("learner", "--env", "my_env:Here-v0", *FAST, *options)
    actor = start("actor", "--n", "1", "--connect", endpoint, "--metrics-port", "-1")
    assert learner.process.wait(PATIENCE_S) == 0, learner.text() + actor.text()
    assert events(here / "run", "restart") == []
    assert evaluate(here, "run", "--episodes", "2")["lengths"] == [50, 50]


@pytest.mark.long
def test_information_of_an_episode_is_in_every_place(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """Every second episode is a success, and all are a quarter away.

    What is observed is a Dict; the order of its numbers is in the policy.
    """
    options = ("--listen", endpoint, "--run-dir", "run", "--total-steps", "1024", "--n", "1")
    learner = start(
        "learner", "--env", "a2s_case_numbers:Success-v0", "--info-metric", "distance", *FAST,
        *options, "--metrics-port", "0",
    )  # fmt: skip
    start("actor", "--n", "1", "--connect", endpoint, "--metrics-port", "-1")
    wait_for(lambda: "/metrics" in learner.text(), "the learner")
    port, seen = metrics_port(learner), dict[str, float]()

    def ended() -> bool:
        with suppress(OSError):
            seen.update(scrape(port))
        return learner.process.poll() is not None

    wait_for(ended, "the end", timeout_s=PATIENCE_S)
    assert learner.process.returncode == 0, learner.text()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["info_metrics"]["distance"] == pytest.approx(0.25)
    assert summary["info_metrics"]["is_success"] == pytest.approx(0.5, abs=0.1)
    header, *lines = (tmp_path / "run" / "episodes.csv").read_text().splitlines()
    columns = header.split(",")
    assert {*columns[columns.index("terminated") + 1 :]} == {"is_success", "distance"}
    successes = [float(line.split(",")[columns.index("is_success")]) for line in lines]
    assert {*successes} == {0.0, 1.0}
    assert seen['a2s_learner_episode_info_mean{metric="distance"}'] == pytest.approx(0.25)
    assert 0 <= seen['a2s_learner_episode_info_mean{metric="is_success"}'] <= 1
    found = evaluate(tmp_path, "run", "--episodes", "4")["info_metrics"]
    assert found["distance"] == pytest.approx(0.25)
    assert found["is_success"] == 0.5  # two in each of two environments
    policy = tmp_path / "run" / "latest" / "policy.onnx"
    assert _obs_size(policy) == 9
    layout = json.loads(_metadata(policy)["obs_layout"])
    assert [size for _, size in layout] == [2, 2, 3, 2]
    names = [name for name, _ in layout]
    assert ["arm" in name for name in names] == [True, True, False, False]
    assert ("gear" in names[2], "velocity" in names[3]) == (True, True)


@pytest.mark.parametrize(
    ("env", "code", "said"),
    [
        ("a2s_case_envs:Control-v0", 0, "actions/s"),
        pytest.param("a2s_case_envs:InPlace-v0", 0, "actions/s", marks=pytest.mark.long),
        pytest.param("a2s_case_numbers:Matrix-v0", 0, "actions/s", marks=pytest.mark.long),
        ("a2s_case_mistakes:FourValues-v0", 1, "step returned 4 values, expected 5"),
        ("a2s_case_numbers:Image-v0", 2, "(84, 84, 3)"),
    ],
)
def test_a_check_is_one_page(tmp_path: Path, env: str, code: int, said: str) -> None:
    done = a2s("check", env, cwd=tmp_path)
    assert done.code == code, done.err
    text = done.out + done.err
    assert said in text
    assert text.count("\n") <= 40
    assert "Traceback" not in text
    assert [*tmp_path.iterdir()] == []
    assert A2S[0] not in text
