"""Checkpoints: whole or not at all, and a damaged one is never used."""

import gc
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from a2s.learner.run import checkpoint
from a2s.protocol.errors import RunDirectoryError

TENSORS = {"a": torch.arange(6.0).reshape(2, 3), "generator": torch.Generator().get_state()}
STATE = {"updates": 3, "best": None, "r": [0.1, -2.5e-300]}


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path, size = checkpoint.save(tmp_path / "c", 3, TENSORS, STATE, kind="k")
    tensors, state = checkpoint.load(tmp_path / "c", kind="k")
    assert state == STATE
    assert all(torch.equal(tensors[name], tensor) for name, tensor in TENSORS.items())
    assert tensors["generator"].dtype == torch.uint8
    assert size == sum(file.stat().st_size for file in path.iterdir())


def test_saving_leaves_nothing_to_be_collected(tmp_path: Path) -> None:
    """A run saves for days, and what is in cycles waits for as much as there is of libraries."""
    checkpoint.save(tmp_path, 1, TENSORS, STATE, kind="k")
    gc.collect()
    gc.disable()
    try:
        for updates in range(2, 12):
            checkpoint.save(tmp_path, updates, TENSORS, STATE, kind="k")
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_the_newest_is_loaded_and_three_are_kept(tmp_path: Path) -> None:
    for updates in (1, 20, 40, 60, 1000):
        checkpoint.save(tmp_path, updates, TENSORS, {"updates": updates}, kind="k")
    assert checkpoint.load(tmp_path, kind="k")[1] == {"updates": 1000}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000040", "00000060", "00001000"]


def test_the_newest_is_that_of_most_updates_however_many_digits_they_have(tmp_path: Path) -> None:
    for updates in (99_999_800, 99_999_900, 100_000_000, 100_000_000, 100_000_100):
        checkpoint.save(tmp_path, updates, TENSORS, {"updates": updates}, kind="k")
    assert [each.name for each in checkpoint.all_of(tmp_path)] == [
        "100000000", "100000000-0001", "100000100"
    ]  # fmt: skip
    assert checkpoint.load(tmp_path, kind="k")[1] == {"updates": 100_000_100}


def test_one_of_the_same_update_takes_the_place_of_none(tmp_path: Path) -> None:
    """Whoever is killed while it is written loses nothing."""
    for count in range(5):
        checkpoint.save(tmp_path, 7, TENSORS, {"count": count}, kind="k")
        assert checkpoint.load(tmp_path, kind="k")[1] == {"count": count}
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "00000007-0002", "00000007-0003", "00000007-0004"
    ]  # fmt: skip
    checkpoint.save(tmp_path, 8, TENSORS, {"count": 5}, kind="k")
    assert checkpoint.load(tmp_path, kind="k")[1] == {"count": 5}


def test_a_copy_that_a_user_has_made_beside_them_is_none(tmp_path: Path) -> None:
    for name in ("00000007-backup", "00000007.bak", "2026-11-30"):
        (tmp_path / name).mkdir()
    for _ in range(2):
        checkpoint.save(tmp_path, 7, TENSORS, STATE, kind="k")
    assert [each.name for each in checkpoint.all_of(tmp_path)] == ["00000007", "00000007-0001"]


def test_one_of_another_kind_is_refused(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 1, TENSORS, STATE, kind="off-policy on Hopper-v5")
    with pytest.raises(RunDirectoryError, match="found off-policy on Hopper-v5, expected k; --res"):
        checkpoint.load(tmp_path, kind="k")


def test_one_that_was_not_finished_is_not_seen(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 1, TENSORS, {"updates": 1}, kind="k")
    (tmp_path / ".00000002.partial").mkdir()
    assert checkpoint.load(tmp_path, kind="k")[1] == {"updates": 1}


@pytest.mark.parametrize("name", ["tensors.safetensors", "state.json", "SHA256SUMS"])
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_of_a_damaged_one_the_one_before_is_used_and_that_is_said(
    tmp_path: Path, name: str, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint.save(tmp_path, 1, TENSORS, {"updates": 1}, kind="k")
    path, _ = checkpoint.save(tmp_path, 2, TENSORS, {"updates": 2}, kind="k")
    file = path / name
    data = bytearray(file.read_bytes())
    if damage == "remove":
        file.unlink()
    else:
        data[len(data) // 2] ^= 0xFF
        file.write_bytes(data if damage == "flip" else data[: len(data) // 2])
    assert checkpoint.load(tmp_path, kind="k")[1] == {"updates": 1}
    assert "00000002: " in caplog.text
    assert "; going on from the one before" in caplog.text
    shutil.rmtree(tmp_path / "00000001")
    caplog.clear()
    words = "each of 1 checkpoints is damaged; restore one from a copy, or begin another run"
    with pytest.raises(RunDirectoryError, match=words):
        checkpoint.load(tmp_path, kind="k")
    assert "00000002: " in caplog.text
    assert "the one before" not in caplog.text


def test_no_flipped_byte_is_used(tmp_path: Path) -> None:
    """Of the state and the checksums; those of the tensors are as many as there are numbers."""
    path, _ = checkpoint.save(tmp_path, 2, TENSORS, STATE, kind="k")
    for name in ("state.json", "SHA256SUMS"):
        whole = (path / name).read_bytes()
        for at in range(len(whole)):
            for bit in (0x01, 0x20):
                (path / name).write_bytes(whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :])
                with pytest.raises(RunDirectoryError, match="each of 1 checkpoints is damaged"):
                    checkpoint.load(tmp_path)
        (path / name).write_bytes(whole)
    assert checkpoint.load(tmp_path)[1] == STATE


@pytest.mark.parametrize("damage", ["flip", "null", "remove", "a folder", "no sums"])
def test_states_are_those_that_are_as_they_were_written(tmp_path: Path, damage: str) -> None:
    """A journal is kept for them: a damaged one names no place in it, or a wrong one."""
    for updates in (1, 2):
        path, _ = checkpoint.save(tmp_path, updates, TENSORS, {"updates": updates}, kind="k")
    assert checkpoint.states(tmp_path) == [{"updates": 1}, {"updates": 2}]
    state = path / "state.json"
    if damage == "flip":
        state.write_bytes(state.read_bytes().replace(b"updates", b"updated"))
    elif damage == "null":
        state.write_text("null")
    elif damage == "no sums":
        (path / "SHA256SUMS").unlink()
    else:
        state.unlink()
    if damage == "a folder":
        state.mkdir()
    assert checkpoint.states(tmp_path) == [{"updates": 1}]


def test_what_a_kill_left_is_removed_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".00000001.partial").mkdir()
    checkpoint.save(tmp_path, 2, TENSORS, STATE, kind="k")
    assert [each.name for each in tmp_path.iterdir()] == ["00000002"]


def test_the_checksums_are_those_of_sha256sum(tmp_path: Path) -> None:
    path, _ = checkpoint.save(tmp_path, 2, TENSORS, STATE, kind="k")
    checked = subprocess.run(
        ["sha256sum", "--check", "--strict", "SHA256SUMS"],
        cwd=path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert checked.stdout == "tensors.safetensors: OK\nstate.json: OK\n"


def test_resuming_without_one_says_so(tmp_path: Path) -> None:
    """Not to start without --resume, which says to add it, nor to delete what is left."""
    words = "found no checkpoint to go on from; restore one from a copy, or begin another run$"
    with pytest.raises(RunDirectoryError, match=words):
        checkpoint.load(tmp_path / "none", kind="k")


@pytest.mark.parametrize("has_sums", [True, False], ids=["checksums", "none, as once"])
def test_one_of_another_version_is_refused_by_name(
    tmp_path: Path, has_sums: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "_FORMAT", 5)
    path, _ = checkpoint.save(tmp_path, 1, TENSORS, STATE, kind="k")
    monkeypatch.undo()
    if not has_sums:
        (path / "SHA256SUMS").unlink()
    with pytest.raises(RunDirectoryError, match=r"found format 5, expected \d+; another version"):
        checkpoint.load(tmp_path, kind="k")
