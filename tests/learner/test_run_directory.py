"""The directory of a run: where it is, and what stands in it."""

import json
from pathlib import Path

import pytest

from a2s.learner.run_directory import RunDirectory, choose
from a2s.protocol.errors import UsageError


def _made(path: Path) -> Path:
    path.mkdir(parents=True)
    (path / "config.toml").touch()
    return path


def test_a_run_gets_a_directory_of_its_own(tmp_path: Path) -> None:
    assert choose(tmp_path, "hop", None, resume=False) == tmp_path / "hop"
    _made(tmp_path / "hop")
    assert choose(tmp_path, "hop", None, resume=False) == tmp_path / "hop-2"
    _made(tmp_path / "hop-2")
    assert choose(tmp_path, "hop", None, resume=True) == tmp_path / "hop-2"


def test_a_named_directory_is_never_overwritten(tmp_path: Path) -> None:
    path = _made(tmp_path / "mine")
    assert choose(tmp_path, "hop", path, resume=True) == path
    with pytest.raises(UsageError, match="holds a run; add --resume, or name another"):
        choose(tmp_path, "hop", path, resume=False)


def test_nothing_to_resume_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="found no run 'hop'"):
        choose(tmp_path, "hop", None, resume=True)


def test_files_are_continued_and_redone_updates_are_forgotten(tmp_path: Path) -> None:
    for _ in range(2):
        directory = RunDirectory(tmp_path, ("update", "loss"), lambda: 1.5)
        directory.update({"update": 1, "loss": 0.123456789})
        directory.update({"update": 2, "loss": float("nan")})
        directory.event("start", generation=directory.count_start())
        directory.close()
    directory = RunDirectory(tmp_path, ("update", "loss"), lambda: 1.5)
    directory.keep_updates(1)
    directory.update({"update": 2, "loss": 0.5})
    directory.close()
    assert (tmp_path / "updates.csv").read_text() == "update,loss\n1,0.123456789\n2,0.5\n"
    events = [json.loads(x) for x in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [(e["event"], e["generation"], e["wall_s"]) for e in events] == [
        ("start", 1, 1.5),
        ("start", 2, 1.5),
    ]


def test_episodes_are_read_back(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    row = {"env_steps": 5, "actor": 0, "weights_version": 1, "length": 5, "terminated": 1}
    directory.episode(**row, **{"return": "-3.25"})
    assert list(directory.read_episodes()) == [(-3.25, 5)]
    directory.close()
    header, line = (tmp_path / "episodes.csv").read_text().splitlines()
    assert header == "wall_s,env_steps,actor,weights_version,return,length,terminated"
    assert line == "0.000,5,0,1,-3.25,5,1"
