"""A run is learned again from its journal, to the same weights."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from case_runs import a2s
from system_helpers import FAST, OFF_POLICY, REACH

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

RunA2S = Callable[..., dict[str, Any]]
OF_ASYNC = {
    "on-policy": (*REACH, *FAST, "--async", "--total-steps", "6000"),
    "off-policy": (*REACH, *OFF_POLICY, "--total-steps", "400"),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "variant", ["on-policy", pytest.param("off-policy", marks=pytest.mark.long)]
)
def test_an_async_run_is_learned_again_to_the_same_weights(
    run_a2s: RunA2S, tmp_path: Path, variant: str
) -> None:
    """Without its journal it cannot be, and nothing is left."""
    options = (*OF_ASYNC[variant], "--n", "2")
    summary = run_a2s("train", *options, "--run-dir", "run", "--seed", "3")
    told = ("learner", "--replay-journal", "run", "--metrics-port", "-1", "--json", "--run-dir")
    done = a2s(*told, "again", cwd=tmp_path)
    assert done.code == 0, done.err
    again = json.loads(done.out.splitlines()[-1])
    assert again["weights_sha256"] == summary["weights_sha256"]
    assert again["updates"] == summary["updates"]
    assert again["equal"]
    damaged = again["equal"][0]
    (tmp_path / "run" / "checkpoints" / damaged / "SHA256SUMS").unlink()
    without = a2s(*told, "without", cwd=tmp_path)
    assert without.code == 0, without.err
    assert json.loads(without.out.splitlines()[-1])["equal"] == again["equal"][1:]
    for later in sorted((tmp_path / "run" / "checkpoints").iterdir())[1:]:
        shutil.rmtree(later)
    alone = a2s("learner", "--replay-journal", "run", "--metrics-port", "-1", cwd=tmp_path)
    assert (alone.code, "nothing compared: there is no checkpoint after" in alone.out) == (0, True)
    if variant == "off-policy":
        (tmp_path / "run" / "replay").rename(tmp_path / "moved")
        refused = a2s(*told, "other", cwd=tmp_path)
        assert (refused.code, "replay is not there any more" in refused.last) == (2, True)
        assert not (tmp_path / "other").exists()
    shutil.rmtree(tmp_path / "run" / "journal")
    refused = a2s(*told, "other", cwd=tmp_path)
    assert refused.code == 2
    assert "run has no checkpoint whose journal is there" in refused.last
    assert not (tmp_path / "other").exists()


@pytest.mark.long
def test_the_run_that_compiles_repeats_to_the_same_weights(tmp_path: Path) -> None:
    """The first run of a machine is as those that load what it has compiled."""
    weights = []
    for run in ("first", "second"):
        options = (*REACH, *FAST, "--total-steps", "600", "--seed", "3", "--run-dir", run, "--json")
        done = a2s("train", *options, cwd=tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "kept"))
        assert done.code == 0, done.err
        assert ("compiling" in done.err) == (run == "first")
        weights.append(json.loads(done.out.splitlines()[-1])["weights_sha256"])
    assert weights[0] == weights[1]
