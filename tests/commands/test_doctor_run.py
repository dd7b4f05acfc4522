"""a2s doctor RUN: every file that --resume reads is verified, and named if it is damaged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from scripted_actors import Script
from typer.testing import CliRunner

from a2s.cli import app
from a2s.learner.run import checkpoint
from a2s.learner.run.directory import claimed

SMALL = {"policy_sizes": (8,), "value_sizes": (8,), "q_sizes": (8,), "q_steps": 1}


@pytest.fixture(scope="module")
def make_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Make the directory of a run with checkpoints after 5 and 10 updates."""

    def make(variant: str) -> Path:
        path = tmp_path_factory.mktemp(variant) / "run"
        options = {"variant": variant, "total_steps": 400, "checkpoint_every_updates": 5}
        settings = {**SMALL, "batch_steps": 32, "first_batch_steps": 32, "window_steps": 64}
        if variant == "off-policy":
            settings = {"warm_up_steps": 400, "batch_rows": 8, "replay_rows": 1000}
        Script(path, options, settings).run()
        (path / "config.toml").touch()
        return path

    return make


def _findings(path: Path) -> dict[str, dict[str, str]]:
    result = CliRunner().invoke(app, ["doctor", str(path), "--json"])
    return {each["name"]: each for each in json.loads(result.stdout)}


def _examine(path: Path) -> tuple[int, dict[str, tuple[str, str]]]:
    result = CliRunner().invoke(app, ["doctor", str(path), "--json"])
    found = {each["name"]: (each["state"], each["found"]) for each in json.loads(result.stdout)}
    return result.exit_code, found


def test_of_a_whole_run_all_is_ok(make_run: Callable[[str], Path]) -> None:
    for variant in ("on-policy", "off-policy"):
        code, found = _examine(make_run(variant))
        assert code == 0
        assert {state for state, _ in found.values()} == {"ok"}
        assert {"ledger", "journal"} < set(found)
        assert ("replay" in found) == (variant == "off-policy")


def test_a_replay_that_is_gone_is_missed(make_run: Callable[[str], Path]) -> None:
    path = make_run("off-policy")
    shutil.rmtree(path / "replay")
    code, found = _examine(path)
    assert (code, found["replay"]) == (1, ("fail", f"{path / 'replay'} is not there any more"))


@pytest.mark.parametrize(
    ("place", "name", "state"),
    [
        ("checkpoints/*/state.json", "checkpoint", "note"),
        ("updates.csv", "updates.csv", "note"),
        ("segments.log", "ledger", "fail"),
        ("journal/*", "journal", "fail"),
        ("replay/obs-1.f32", "replay", "fail"),
    ],
)
def test_what_is_damaged_is_named(
    make_run: Callable[[str], Path], place: str, name: str, state: str
) -> None:
    """In the middle of its newest file; a damaged checkpoint has others before it."""
    path = make_run("off-policy" if name == "replay" else "on-policy")
    file = [each for each in sorted(path.glob(place)) if each.stat().st_size][-1]
    data = bytearray(file.read_bytes())
    data[len(data) // 2 if name != "replay" else 0] ^= 0xFF
    file.write_bytes(data)
    code, found = _examine(path)
    bad = {each: told for each, told in found.items() if told[0] != "ok"}
    assert [each.split()[0] for each in bad] == [name]
    assert next(iter(bad.values()))[0] == state
    assert code == (state == "fail")


def test_a_run_that_is_not_one_or_is_at_work_is_refused(
    make_run: Callable[[str], Path], tmp_path: Path
) -> None:
    result = CliRunner().invoke(app, ["doctor", str(tmp_path)])
    assert "holds no config.toml" in str(result.exception)
    path = make_run("on-policy")
    with claimed(path):
        result = CliRunner().invoke(app, ["doctor", str(path)])
    assert str(result.exception) == (
        f"{path}: a learner is at work there; its files are looked at when it has stopped; "
        f"a2s status {path} shows it now"
    )


@pytest.mark.parametrize(
    ("variant", "state", "remedy"),
    [
        ("on-policy", "note", "; else --resume goes on, and the accounts lack what is gone"),
        ("off-policy", "fail", ": --resume refuses"),
    ],
)
def test_a_ledger_that_has_lost_its_end_is_told_with_both_numbers(
    make_run: Callable[[str], Path], variant: str, state: str, remedy: str
) -> None:
    path = make_run(variant)
    _, before = _examine(path)
    (path / "segments.log").write_bytes(b"")
    steps = before["ledger"][1].split(", ")[1]
    found = _findings(path)["ledger"]
    assert found["state"] == state
    assert found["found"] == f"{path / 'segments.log'}: 0 steps, the checkpoint knows {steps[:-6]}"
    assert found["remedy"] == f"restore it from a copy{remedy}"


def test_a_journal_that_is_gone_is_a_note_and_says_what_is_lost(
    make_run: Callable[[str], Path],
) -> None:
    """The run has ended with a checkpoint, so it is nothing; then with the one before."""
    path = make_run("on-policy")
    shutil.rmtree(path / "journal")
    found = _findings(path)["journal"]
    assert found["state"] == "note"
    assert found["remedy"] == "--resume goes on: nothing came after that, and nothing is lost"
    shutil.rmtree(max((path / "checkpoints").iterdir()))
    found = _findings(path)["journal"]
    assert found["state"] == "note"
    assert "steps since then count and are not learned from" in found["remedy"]


def test_a_journal_that_lacks_what_the_ledger_has_is_refused_as_a_resume_does(
    make_run: Callable[[str], Path],
) -> None:
    path = make_run("on-policy")
    shutil.rmtree(max((path / "checkpoints").iterdir()))
    _, before = _examine(path)
    assert before["journal"][0] == "ok"
    file, end, _ = checkpoint.load(path / "checkpoints")[1]["journal"]
    for each in (path / "journal").iterdir():
        each.write_bytes(each.read_bytes()[: end if int(each.name) == file else 0])
    found = _findings(path)["journal"]
    assert found["state"] == "fail"
    assert "steps fewer than in segments.log" in found["found"]


def test_of_a_damaged_checkpoint_the_one_before_is_used_where_there_is_one(
    make_run: Callable[[str], Path],
) -> None:
    path = make_run("on-policy")
    for each in sorted((path / "checkpoints").iterdir(), reverse=True):
        (each / "state.json").write_text("")
    found = _findings(path)
    assert found.pop("checkpoints")["remedy"] == "restore one from a copy, or begin another run"
    notes = [each for name, each in found.items() if name.startswith("checkpoint ")]
    assert {each["remedy"] for each in notes} == {"restore it from a copy"}
