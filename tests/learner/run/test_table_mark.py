"""Tables have no checksums of their own; a checkpoint knows what they began with."""

import json
from pathlib import Path

import pytest

from a2s.learner.run.directory import RunDirectory
from a2s.learner.run.table_mark import TableMark, changed, marks_of

ROW = (5, 0, 1, "1.5", 5, 1)


def _directory(path: Path) -> RunDirectory:
    return RunDirectory(path, ("update", "loss"), lambda: 1.5)


@pytest.fixture
def known(tmp_path: Path) -> dict[str, TableMark]:
    """What a checkpoint knows of two rows in each table, as JSON keeps it."""
    directory = _directory(tmp_path)
    for update in (1, 2):
        directory.update({"update": update, "loss": 0.5})
        directory.episode(ROW, {"success, or not": 1.0})
        directory.evaluation((5, 1, "mean", 1, 1, 0, 1, 1, 5), {})
    directory.close()
    found: dict[str, TableMark] = json.loads(json.dumps(marks_of(tmp_path)))
    assert list(found) == ["episodes.csv", "updates.csv", "evaluations.csv"]
    return found


def test_rows_and_columns_that_were_added_change_nothing(
    tmp_path: Path, known: dict[str, TableMark]
) -> None:
    """Nor that the rows past a checkpoint were forgotten, by a learner that was killed then."""
    for _ in range(2):
        directory = _directory(tmp_path)
        directory.keep_updates(2)
        directory.keep_episodes(2)
        directory.update({"update": 3, "loss": 0.25})
        directory.episode(ROW, {"distance": 2.0})
        directory.evaluation((9, 1, "mean", 1, 1, 0, 1, 1, 5), {"success": 1.0})
        directory.close()
        assert changed(tmp_path, known) == []


@pytest.mark.parametrize("widened", [False, True])
@pytest.mark.parametrize("name", ["episodes.csv", "updates.csv", "evaluations.csv"])
def test_every_changed_bit_is_noticed(
    tmp_path: Path, known: dict[str, TableMark], name: str, widened: bool
) -> None:
    """Also in a table that has got more columns since, up to those."""
    if widened:
        directory = _directory(tmp_path)
        directory.episode(ROW, {"distance": 2.0})
        directory.evaluation((9, 1, "mean", 1, 1, 0, 1, 1, 5), {"success": 1.0})
        directory.close()
    whole = (tmp_path / name).read_bytes()
    added = {"episodes.csv": b",distance", "evaluations.csv": b",success"}
    size = whole.index(added.get(name, b"\r") if widened else b"\r")
    for at in range(size):
        for bit in (0x01, 0x80):
            damaged = whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :]
            (tmp_path / name).write_bytes(damaged)
            assert changed(tmp_path, known) == [name]


@pytest.mark.parametrize("text", [None, "", "update,loss\r\n", '"' + "1" * 200_000])
def test_a_table_that_is_gone_or_cut_is_another(
    tmp_path: Path, known: dict[str, TableMark], text: str | None
) -> None:
    (tmp_path / "updates.csv").unlink()
    if text is not None:
        (tmp_path / "updates.csv").write_text(text, newline="")
    assert changed(tmp_path, known) == ["updates.csv"]
