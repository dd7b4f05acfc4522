"""Which directory a run is kept in: no other run is lost in it, and no refused one left."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest
from segments import segment
from typer.testing import CliRunner

from a2s.cli import app
from a2s.learner.replay import directory
from a2s.learner.run.choice import choose, made, remove_traces
from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Spaces


def _made(path: Path) -> Path:
    path.mkdir(parents=True)
    (path / "config.toml").touch()
    return path


def _refused(path: Path) -> Path:
    """What a refused start leaves."""
    (path / "journal").mkdir(parents=True)
    for name in ("lock", "segments.log", "journal/00000000"):
        (path / name).touch()
    return path


def _left(path: Path, place: str) -> Path:
    """What is left of a run that has lost its configuration."""
    _refused(path)
    file = path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("learned")
    return path


def _files(path: Path) -> dict[Path, bytes | None]:
    return {each: each.read_bytes() if each.is_file() else None for each in path.rglob("*")}


def test_a_run_gets_a_directory_of_its_own(tmp_path: Path) -> None:
    assert choose(tmp_path, "hop", None, resume=False) == tmp_path / "hop"
    _made(tmp_path / "hop")
    assert choose(tmp_path, "hop", None, resume=False) == tmp_path / "hop-2"
    _made(tmp_path / "hop-2")
    (tmp_path / "hop-3").mkdir()
    assert choose(tmp_path, "hop", None, resume=False) == tmp_path / "hop-4"
    assert choose(tmp_path, "hop", None, resume=True) == tmp_path / "hop-2"  # 3 never began


def test_runs_that_begin_at_once_get_directories_of_their_own(tmp_path: Path) -> None:
    """One in which nothing is written is removed, with the root that it has made."""
    root = tmp_path / "runs"
    together = Barrier(8)

    def begin(_number: int) -> Path:
        together.wait()
        with made(root, "hop") as path:
            together.wait()
        return path

    with ThreadPoolExecutor(8) as threads:
        paths = set(threads.map(begin, range(8)))
    assert paths == {root / "hop"} | {root / f"hop-{number}" for number in range(2, 9)}
    with made(tmp_path / "other", "hop") as path:
        assert path.is_dir()
    assert not (tmp_path / "other").exists()
    assert not list(root.glob("*"))
    with made(root, "hop") as path:
        (path / "config.toml").touch()
    assert path.exists()


def test_a_start_that_is_refused_leaves_no_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["learner", "--env", "NoSuchThing-v5"])
    assert isinstance(done.exception, UsageError)
    assert not list(tmp_path.iterdir())


def test_a_named_directory_is_never_overwritten(tmp_path: Path) -> None:
    path = _made(tmp_path / "mine")
    assert choose(tmp_path, "hop", path, resume=True) == path
    with pytest.raises(UsageError, match="holds a run; add --resume, or name another"):
        choose(tmp_path, "hop", path, resume=False)


def test_nothing_to_resume_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="found no run 'hop'"):
        choose(tmp_path, "hop", None, resume=True)
    with pytest.raises(UsageError, match=r"hop holds no config.toml; name a run directory$"):
        choose(tmp_path, "hop", tmp_path / "hop", resume=True)


@pytest.mark.parametrize(
    ("place", "what"),
    [
        ("segments.log", "a segments.log of 7 bytes"),
        ("checkpoints/00000020/state.json", "checkpoint 00000020"),
        ("checkpoints/00000020-0001/state.json", "checkpoint 00000020-0001"),
    ],
)
def test_no_run_begins_in_one_that_has_lost_its_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, what: str
) -> None:
    """Nor does an older one go on in its stead; the doctor says the same."""
    monkeypatch.chdir(tmp_path)
    _made(Path("runs/hop"))
    path = _left(Path("runs/hop-2"), place)
    said = f"{path} holds {what}, but no config.toml; restore config.toml from a copy, or name "
    before = _files(path)
    for words, subject in (
        (["learner", "--env", "Hopper-v5", "--run-dir", str(path)], "--run-dir: "),
        (["train", "--env", "Hopper-v5", "--run-dir", str(path)], "--run-dir: "),
        (["learner", "--resume", "--run-dir", str(path)], "--resume: "),
        (["learner", "--resume", "--run", "hop"], "--resume: "),
        (["doctor", str(path)], ""),
    ):
        error = CliRunner().invoke(app, words).exception
        assert isinstance(error, UsageError)
        assert str(error) == f"{subject}{said}another directory"
    assert _files(path) == before


def test_what_a_kill_left_before_the_configuration_begins_anew(tmp_path: Path) -> None:
    """The first checkpoints are there, and nobody was answered."""
    path = _refused(tmp_path / "run")
    for name in ("00000000", "00000000-0001"):
        (path / "checkpoints" / name).mkdir(parents=True)
    assert choose(tmp_path, "hop", path, resume=False) == path


def test_of_a_refused_run_nothing_is_left(tmp_path: Path) -> None:
    path = _refused(tmp_path / "refused")
    (path / "actors.log").write_text("a2s: nobody answers")
    remove_traces(path)
    assert len(_files(path)) == 5  # an actors.log is of another
    remove_traces(path, "actors.log")
    remove_traces(tmp_path / "never")
    assert list(tmp_path.iterdir()) == []


def test_a_replay_is_left_only_where_a_row_or_something_else_is_in_it(tmp_path: Path) -> None:
    bounds = np.ones(1, np.float32)
    spaces = Spaces(obs_size=3, action_low=-bounds, action_high=bounds)
    for name in ("unused", "noted", "used"):
        path = _refused(tmp_path / name)
        with closing(directory.create(path / "replay", "Pendulum-v1", spaces, 9)) as replay:
            if name == "used":
                replay.insert(segment(0, 5, obs_size=3, action_size=1))
    (tmp_path / "noted" / "replay" / "notes").touch()
    used = _files(tmp_path / "used") | _files(tmp_path / "noted")
    for name in ("unused", "noted", "used"):
        remove_traces(tmp_path / name)
    assert _files(tmp_path / "used") | _files(tmp_path / "noted") == used
    assert not (tmp_path / "unused").exists()


@pytest.mark.parametrize(
    "place",
    ["segments.log", "journal/00000000", "journal/notes", "notes", "config.toml", "replay/obs"],
)
def test_where_anything_else_is_nothing_is_removed(tmp_path: Path, place: str) -> None:
    """A run without its configuration, for example, or a folder of the user's."""
    path = _left(tmp_path / "run", place)
    before = _files(path)
    remove_traces(path, "actors.log")
    assert _files(path) == before


def test_folders_that_are_links_stay(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "journal").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    before = _files(tmp_path)
    remove_traces(tmp_path / "run")
    remove_traces(tmp_path / "link")
    assert _files(tmp_path) == before
