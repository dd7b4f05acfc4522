"""What a learner goes on with: its files as it left them, or it changes none."""

import shutil
from pathlib import Path

import pytest
from learners import learner_of

from a2s.actors.environments.environment import Environment
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.learner import Learner
from a2s.learner.run import checkpoint
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.in_process import Exchange, InProcessBus

ENV = "a2s_test_envs:Reach-v0"
ROW = "1000.000,8,0,1,2.5,8,0\r\n"


def _learner(path: Path, *, resume: bool) -> Learner:
    spaces = Environment(EnvConfig(env_id=ENV)).spaces
    bus = InProcessBus(Exchange())
    return learner_of({"env": ENV}, {}, bus, path, spaces=spaces, resume=resume)


def _files(path: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("generation", "two", "generation: found 'two', expected how often the run was started"),
        ("generation", "9999999999", "generation: found '9999999999', expected how often"),
        ("episodes.csv", f"wall,steps\r\n{ROW}", r"episodes.csv line 1: found .*, expected wall_s"),
        (
            "episodes.csv",
            "{header}1,8,0,1,?,8,0\r\n",
            r"episodes.csv line 2: found '1,8,0,1,\?,8,0'",
        ),
    ],
)
def test_a_file_that_is_not_as_it_was_left_is_named_and_none_is_changed(
    tmp_path: Path, name: str, text: str, said: str
) -> None:
    _learner(tmp_path, resume=False).run(lambda: True)
    header = (tmp_path / "episodes.csv").read_bytes().decode()
    (tmp_path / name).write_bytes(text.replace("{header}", header).encode())
    with (tmp_path / "updates.csv").open("a") as file:
        file.write("made after the checkpoint\n")  # it would be forgotten
    before = _files(tmp_path)
    with pytest.raises(RunDirectoryError, match=said):
        _learner(tmp_path, resume=True)
    assert _files(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "place"),
    [("updates.csv", 3), ("episodes.csv", 3), ("episodes.csv", -3), ("evaluations.csv", -3)],
)
def test_a_byte_that_is_not_utf_8_is_one_line(tmp_path: Path, name: str, place: int) -> None:
    _learner(tmp_path, resume=False).run(lambda: True)
    table = bytearray(b"wall_s,env_steps,return_mean,return_std,mode\n1,1,1,1,mean\n")
    if name != "evaluations.csv":
        table = bytearray((tmp_path / name).read_bytes())
        table += ROW.encode() * 1000 if name == "episodes.csv" else b""
    table[place] = 0xFF
    (tmp_path / name).write_bytes(table)
    before = _files(tmp_path)
    with pytest.raises(RunDirectoryError, match=f"{name}: found the byte 0xff, expected UTF-8; "):
        _learner(tmp_path, resume=True)
    assert _files(tmp_path) == before


def test_a_table_that_was_changed_is_named_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One line for each, until the next checkpoint knows them as they are now."""

    def resume(*changes: tuple[str, bytes, bytes]) -> list[str]:
        for name, old, new in changes:
            whole = (tmp_path / name).read_bytes()
            assert old in whole
            (tmp_path / name).write_bytes(whole.replace(old, new, 1))
        caplog.clear()
        _learner(tmp_path, resume=True).run(lambda: True)
        return [line.partition("; ")[0] for line in caplog.messages]

    _learner(tmp_path, resume=False).run(lambda: True)
    table = "wall_s,env_steps,return_mean,return_std,mode\n1,1,1.5,1,mean\n"
    (tmp_path / "evaluations.csv").write_text(table)
    assert resume() == []
    changes = ("updates.csv", b"update,", b"updote,"), ("evaluations.csv", b"1.5", b"9.5")
    known = "is not what the checkpoint knows"
    assert resume(*changes) == [f"{tmp_path / name}: {known}" for name, *_ in changes]
    assert resume() == []


def test_starts_that_are_no_file_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "generation").mkdir()
    with pytest.raises(RunDirectoryError, match="generation: Is a directory, expected a file with"):
        _learner(tmp_path, resume=False)


def test_a_run_whose_end_cannot_be_saved_has_failed(tmp_path: Path) -> None:
    """It has learned what nobody has; once that is mended it goes on from its journal."""
    learner = _learner(tmp_path, resume=False)
    shutil.rmtree(tmp_path / "latest")
    (tmp_path / "latest").touch()
    with pytest.raises(RunDirectoryError, match=r"latest/policy.onnx: .*; mend that and resume$"):
        learner.run(lambda: True)
    assert not (tmp_path / "summary.json").exists()
    (tmp_path / "latest").unlink()
    _learner(tmp_path, resume=True).run(lambda: True)


def test_without_journal_and_ledger_the_steps_are_those_of_the_checkpoint(tmp_path: Path) -> None:
    _learner(tmp_path, resume=False).run(lambda: True)
    tensors, state = checkpoint.load(tmp_path / "checkpoints")
    state |= {"env_steps": 100, "journal": (0, 1, 0)}
    checkpoint.save(tmp_path / "checkpoints", 0, tensors, state, kind=f"on-policy on {ENV}")
    shutil.rmtree(tmp_path / "journal")
    assert _learner(tmp_path, resume=True).run(lambda: True)["env_steps"] == 100


def test_a_journal_that_was_lost_before_the_first_batch_is_said_to_be(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """And not taken for the empty one with which a run begins."""
    _learner(tmp_path, resume=False).run(lambda: True)
    ledger = Ledger(tmp_path / "segments.log")
    ledger.record("a", 0, "accepted", 10)
    ledger.close()
    shutil.rmtree(tmp_path / "journal")
    for each in sorted((tmp_path / "checkpoints").iterdir())[1:]:
        shutil.rmtree(each)
    assert _learner(tmp_path, resume=True).run(lambda: True)["env_steps"] == 10
    assert "the 10 steps since then count and are not learned from" in caplog.messages[0]


def test_time_goes_on_from_the_last_episode_and_not_from_the_checkpoint(tmp_path: Path) -> None:
    """The steps that were played in between are not played again."""
    _learner(tmp_path, resume=False).run(lambda: True)
    with (tmp_path / "episodes.csv").open("a", newline="") as file:
        file.write(ROW)
    summary = _learner(tmp_path, resume=True).run(lambda: True)
    assert 1000.0 < summary["wall_s"] < 1100.0


def test_a_ledger_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    (tmp_path / "segments.log").mkdir()
    with pytest.raises(RunDirectoryError, match=r"segments.log: Is a directory; mend that"):
        _learner(tmp_path, resume=False)
