"""``a2s train`` refuses a directory before it starts anything, and advises what can be done."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest
from typer.testing import CliRunner

from a2s.cli import app
from a2s.commands import train as train_command
from a2s.commands.train import actors_for, train
from a2s.learner.run.config import assemble
from a2s.learner.run.directory import claimed
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.identity import Security

WaitFor = Callable[..., None]


def _train(path: Path, *, resume: bool = False) -> int:
    return train(
        assemble({"env": "a2s_test_envs:Reach-v0"}, {}),
        path,
        listen=None,
        security=Security(),
        metrics_port=-1,
        metrics_host="127.0.0.1",
        fast_envs=True,
        resume=resume,
        as_json=False,
        again="a2s train --resume",
        evaluation={},
    )


@pytest.mark.parametrize(
    ("cores", "n", "envs"), [(1, 1, 16), (2, 2, 8), (3, 2, 8), (4, 4, 4), (8, 8, 2), (64, 8, 2)]
)
def test_actors_are_chosen_by_cores_and_environments_are_sixteen(
    cores: int, n: int, envs: int
) -> None:
    assert actors_for(cores) == {"n": n, "envs": envs}


@pytest.mark.parametrize(
    ("words", "n", "envs"),
    [((), 4, 4), (("--n", "3"), 3, 8), (("--envs", "5"), 2, 5), (("--config", "c.toml"), 2, 7)],
)
def test_what_the_user_says_is_not_chosen(
    words: tuple[str, ...],
    n: int,
    envs: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("a2s.commands.run_cli.cores_here", lambda: 4)
    Path("c.toml").write_text("[run]\nenvs = 7\n")
    shown = CliRunner().invoke(app, ["train", *words, "--print-config"]).stdout
    found = dict(line.split("#")[0].split(" = ") for line in shown.splitlines() if " = " in line)
    assert (found["n"].strip(), found["envs"].strip()) == (str(n), str(envs))


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("file", "file: File exists; name another --run-dir"),
        ("file/run", "file/run: Not a directory; name another --run-dir"),
    ],
)
def test_a_directory_that_cannot_be_made_is_one_line(tmp_path: Path, path: str, said: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunDirectoryError, match=said):
        _train(tmp_path / path)


def test_a_directory_in_which_a_learner_is_at_work_is_refused(tmp_path: Path) -> None:
    """And the advice is not to go on there."""
    with claimed(tmp_path), pytest.raises(RunDirectoryError, match=r"is at work there; stop it$"):
        _train(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["lock"]


@pytest.mark.parametrize(
    "variable",
    [
        "A2S_PASSWORD",  # for a learner elsewhere; the one that is started here would refuse it
        "A2S_TOTAL_STEPS",  # is in the configuration, unless an option has beaten it
        "A2S_SET",
        "A2S_REPLAY_FROM",  # not of this command
        "A2S_EVALUATE",
    ],
)
def test_what_it_starts_takes_nothing_from_variables(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "x")
    program = f"import os; print({variable!r} in os.environ)"
    monkeypatch.setattr(train_command, "PROGRAM", (sys.executable, "-c", program))
    with (tmp_path / "a.log").open("w") as out, train_command.started([], out) as process:
        assert process.wait(30.0) == 0
    assert (tmp_path / "a.log").read_text() == "False\n"


@pytest.mark.slow
def test_a_learner_that_cannot_begin_has_the_last_word(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its one line says why; no other advises to resume again."""
    (tmp_path / "config.toml").touch()  # without a checkpoint
    assert _train(tmp_path, resume=True) == 1
    assert capfd.readouterr().err.splitlines()[-1].startswith(f"a2s: {tmp_path}")


@pytest.mark.slow
def test_a_learner_that_comes_second_is_no_run_to_go_on_with(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], wait_for: WaitFor
) -> None:
    """The other one began while it started: its line says so, and no other advises to resume."""
    path, over = tmp_path / "run", Event()

    def learn() -> None:
        wait_for((path / "actors.log").exists, "a start")
        with claimed(path):
            (path / "generation").write_text("1")
            over.wait(60.0)

    with ThreadPoolExecutor(1) as other:
        learning = other.submit(learn)
        try:
            assert _train(path) == 1
        finally:
            over.set()
        learning.result()
    assert capfd.readouterr().err.splitlines()[-1].endswith("is at work there; stop it")
