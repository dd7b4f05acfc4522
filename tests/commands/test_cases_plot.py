"""Runs that cannot be drawn do not hinder those that can."""

import sys
from pathlib import Path

import pytest

from a2s import cli

HEADER = "wall_s,env_steps,actor,weights_version,return,length,terminated"


def _run(path: Path, episodes: int, more: str = "") -> None:
    path.mkdir()
    (path / "config.toml").write_text('[run]\nenv = "Hopper-v5"\nalgo = "a2s"\npreset = "modern"\n')
    lines = [f"0,{10 * i},0,1,{i}.5,5,1{',1' if more else ''}" for i in range(1, episodes + 1)]
    (path / "episodes.csv").write_text("\n".join([HEADER + more, *lines]) + "\n")


def _plot(*runs: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    argv, sys.argv = sys.argv, ["a2s", "plot", *runs, "--output", "x.png"]
    code: object = 0
    try:
        cli.main()
    except SystemExit as ended:
        code = ended.code or 0
    finally:
        sys.argv = argv
    said = capsys.readouterr()
    assert isinstance(code, int)
    return code, said.out + said.err


@pytest.mark.parametrize("wrong", ["empty", "damaged", "none", "nowhere"])
def test_the_run_that_cannot_be_drawn_is_named_and_the_others_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], wrong: str
) -> None:
    monkeypatch.chdir(tmp_path)
    _run(tmp_path / "good", 40)
    _run(tmp_path / "empty", 0)
    _run(tmp_path / "damaged", 3)
    (tmp_path / "damaged" / "episodes.csv").write_text(HEADER + "\n1,2,3\n")
    (tmp_path / "none").mkdir()
    code, said = _plot("good", wrong, capsys=capsys)
    assert code == 0, said
    assert wrong in said
    assert "Traceback" not in said
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_to_draw_is_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _run(tmp_path / "empty", 0)
    code, said = _plot("empty", capsys=capsys)
    assert code == 2
    assert "empty" in said
    assert not (tmp_path / "x.png").exists()


def test_a_run_with_information_metrics_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _run(tmp_path / "good", 40, more=",is_success")
    assert _plot("good", capsys=capsys)[0] == 0
