"""A learner that was killed and resumed learns what it would have learned, to the bit."""

import csv
from pathlib import Path
from typing import Any

import pytest
from scripted_actors import WAYS, Script

pytestmark = pytest.mark.timeout(300)  # the first to run may compile

Undisturbed = dict[str, tuple[Path, dict[str, Any]]]

KILLS = {"once": (37,), "often": (5, 33, 35, 62)}


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """Every way of learning, without a kill: its directory and its summary."""
    found = {}
    for way, (options, settings) in WAYS.items():
        path = tmp_path_factory.mktemp("undisturbed") / "run"
        found[way] = path, Script(path, options, settings).run()
    return found


def _require_equal(path: Path, found: dict[str, Any], before: Path, wanted: dict[str, Any]) -> None:
    """Weights, accounts, episodes and updates are the same."""
    assert found["weights_sha256"] == wanted["weights_sha256"]
    for name in ("env_steps", "updates", "episodes", "return_mean_last_10", "recoveries"):
        assert found[name] == wanted[name]
    assert found["segments"]["accepted"] == wanted["segments"]["accepted"]
    for name in ("updates.csv", "episodes.csv"):
        assert _table(path / name) == _table(before / name)


@pytest.mark.parametrize("kills", KILLS)
@pytest.mark.parametrize("way", WAYS)
def test_kill_and_resume_equal_no_kill(
    way: str,
    kills: str,
    tmp_path: Path,
    undisturbed: Undisturbed,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Whatever the moment, however often, and whatever tells the learners from others."""
    path, (options, settings) = tmp_path / "run", WAYS[way]
    script = Script(path, options, settings, kill_at=KILLS[kills], mark=7)
    _require_equal(path, script.run(), *undisturbed[way])
    assert "what came since the checkpoint, from which it learns again" in script.told
    assert "is not what the checkpoint knows" not in caplog.text


@pytest.mark.parametrize("way", ["lockstep", "off-policy"])
def test_and_so_does_going_on_from_the_checkpoint_before_a_damaged_one(
    way: str, tmp_path: Path, undisturbed: Undisturbed, caplog: pytest.LogCaptureFixture
) -> None:
    def damage(path: Path) -> None:
        newest = max((path / "checkpoints").iterdir()) / "tensors.safetensors"
        newest.write_bytes(newest.read_bytes()[:-1])

    path, (options, settings) = tmp_path / "run", WAYS[way]
    found = Script(path, options, settings, kill_at=(62,), on_kill=damage).run()
    _require_equal(path, found, *undisturbed[way])
    assert "the checksums do not match; going on from the one before" in caplog.text
