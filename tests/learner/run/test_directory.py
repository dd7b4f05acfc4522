"""The directory of a run: what stands in it."""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from a2s.learner.run.directory import RunDirectory, claimed
from a2s.learner.run.writing import write_atomically
from a2s.protocol.checks import MAX_METRICS
from a2s.protocol.errors import RunDirectoryError

NoRoom = Callable[[], AbstractContextManager[None]]


@pytest.mark.parametrize("how", ["deleted", "moved", "another in its place"])
def test_a_directory_that_is_gone_is_noticed(tmp_path: Path, how: str) -> None:
    path = tmp_path / "run"
    directory = RunDirectory(path, ("update",), lambda: 0.0)
    directory.update({"update": 1})
    if how == "deleted":
        shutil.rmtree(path)
    else:
        path.rename(tmp_path / "moved")
    if how == "another in its place":
        RunDirectory(path, ("update",), lambda: 0.0).close()
    with pytest.raises(RunDirectoryError, match="deleted or moved while the run went on"):
        directory.update({"update": 2})
    directory.close()


def test_an_event_that_was_torn_does_not_spoil_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "run"
    directory = RunDirectory(path, (), lambda: 0.0)
    directory.event("start")
    directory.close()
    events = path / "events.jsonl"
    events.write_text(events.read_text() + '{"wall_s": 0.0, "ti')
    again = RunDirectory(path, (), lambda: 0.0)
    again.event("join")
    again.close()
    assert [json.loads(line)["event"] for line in events.read_text().splitlines()] == [
        "start",
        "join",
    ]


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


def test_a_damaged_byte_in_an_update_is_kept_as_it_is(tmp_path: Path) -> None:
    """No learner reads it, and what is left of the table is of use."""
    (tmp_path / "updates.csv").write_bytes(b"update,loss\r\n1,0.\xff\r\n2,0.5\r\n")
    directory = RunDirectory(tmp_path, ("update", "loss"), lambda: 0.0)
    directory.keep_updates(1)
    directory.update({"update": 2, "loss": 0.25})
    directory.close()
    table = (tmp_path / "updates.csv").read_bytes()
    assert table == b"update,loss\r\n1,0.\xff\r\n2,0.25\r\n"


def test_a_table_of_updates_keeps_the_columns_that_it_began_with(tmp_path: Path) -> None:
    """A version that has others goes on with it."""
    before = RunDirectory(tmp_path, ("update", "gone", "loss"), lambda: 0.0)
    before.update({"update": 1, "gone": 0.25, "loss": 2.0})
    before.close()
    now = RunDirectory(tmp_path, ("update", "loss", "new"), lambda: 0.0)
    now.keep_updates(1)
    now.update({"update": 2, "loss": 0.5, "new": 3.0})
    now.close()
    assert (tmp_path / "updates.csv").read_text() == "update,gone,loss\n1,0.25,2\n2,,0.5\n"


def test_episodes_are_read_back(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    directory.episode((5, 0, 1, "-3.25", 5, 1), {})
    assert list(directory.read_episodes()) == [(0.0, -3.25, 5, {})]
    directory.close()
    header, line = (tmp_path / "episodes.csv").read_text().splitlines()
    assert header == "wall_s,env_steps,actor,weights_version,return,length,terminated"
    assert line == "0.000,5,0,1,-3.25,5,1"


def test_what_environments_tell_has_columns_from_the_first_episode_that_has_it(
    tmp_path: Path,
) -> None:
    row = (5, 0, 1, "1", 5, 1)
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    directory.episode(row, {})
    directory.episode(row, {"is_success": 1.0})
    directory.close()
    again = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    again.episode(row, {"distance": 0.25})
    told = [metrics for *_, metrics in again.read_episodes()]
    assert told == [{}, {"is_success": 1.0}, {"distance": 0.25}]
    again.close()
    header, first, *_, last = (tmp_path / "episodes.csv").read_text().splitlines()
    assert header.endswith(",terminated,is_success,distance")
    assert (first, last) == ("0.000,5,0,1,1,5,1,,", "0.000,5,0,1,1,5,1,,0.25")


def test_a_table_that_is_as_wide_as_it_may_be_is_not_written_anew(tmp_path: Path) -> None:
    """An episode with more metrics is appended, without them."""
    row, table = (5, 0, 1, "1", 5, 1), tmp_path / "episodes.csv"
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    directory.episode(row, {f"m{i}": 1.0 for i in range(MAX_METRICS)})
    before = table.stat().st_ino
    directory.episode(row, {"m0": 2.0, "more": 3.0})
    assert table.stat().st_ino == before
    *_, (_, _, _, told) = directory.read_episodes()
    assert told == {"m0": 2.0}
    directory.close()


@pytest.mark.parametrize("torn", ["1.000,9", "1.000,9,0,1,-3.25,5,1"])
def test_a_torn_row_is_forgotten(tmp_path: Path, torn: str) -> None:
    RunDirectory(tmp_path, ("update",), lambda: 0.0).close()
    with (tmp_path / "episodes.csv").open("a") as file:
        file.write(f"0.000,5,0,1,1.5,5,1\r\n{torn}")
    directory = RunDirectory(tmp_path, ("update",), lambda: 2.0)
    directory.episode((7, 0, 1, "2.5", 2, 1), {})
    assert list(directory.read_episodes()) == [(0.0, 1.5, 5, {}), (2.0, 2.5, 2, {})]
    directory.close()


def test_one_learner_is_at_work_in_a_directory(tmp_path: Path) -> None:
    with (
        claimed(tmp_path / "run"),
        pytest.raises(RunDirectoryError, match=r"run: another learner is at work there"),
        claimed(tmp_path / "run"),
    ):
        pass
    with claimed(tmp_path / "run"):
        pass


def test_a_file_for_which_there_is_no_room_is_named_and_the_old_one_kept(
    tmp_path: Path, no_room: NoRoom
) -> None:
    path = tmp_path / "policy.onnx"
    write_atomically(path, b"old")
    with no_room(), pytest.raises(RunDirectoryError, match=r"policy.onnx: File too large"):
        write_atomically(path, bytes(1000))
    assert path.read_bytes() == b"old"
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    with no_room(), pytest.raises(RunDirectoryError, match=r"updates.csv: File too large"):
        directory.update({"update": "1" * 1000})
    directory.close()


def test_a_line_that_has_no_room_to_the_end_is_an_error_in_one_line(
    tmp_path: Path, no_room: NoRoom
) -> None:
    """Closing tries to write it once more; the other files are closed all the same."""
    directory = RunDirectory(tmp_path, ("update",), lambda: 0.0)
    with no_room():
        with pytest.raises(RunDirectoryError, match=r"updates.csv: File too large"):
            directory.update({"update": "1" * 1000})
        with pytest.raises(RunDirectoryError, match=r"File too large; mend that and resume"):
            directory.close()
    with pytest.raises(ValueError, match="closed file"):
        directory.event("end")
