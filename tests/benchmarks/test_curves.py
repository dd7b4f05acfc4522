"""Curves are drawn from what is kept, and everything in a table is kept."""

import csv
import gzip
from pathlib import Path

import pytest
from curves import curves
from suites import SUITES, kept_episodes, name_of

from a2s.protocol.errors import UsageError

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SUITE, ENV = "100k", "Hopper-v5"


def _keep(folder: Path, label: str, seed: int, returns: list[float]) -> None:
    results = folder / "results.csv"
    if not results.exists():
        results.write_text("suite,env,label,seed\n")
    with results.open("a") as file:
        file.write(f"{SUITE},{ENV},{label},{seed}\n")
    kept = kept_episodes(folder, SUITE, name_of(SUITE, ENV, label, seed))
    kept.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{10 * (i + 1)},{value}" for i, value in enumerate(returns)]
    kept.write_bytes(gzip.compress("\n".join(["env_steps,return", *rows]).encode()))


@pytest.mark.parametrize("folder", ["on_policy", "off_policy"])
def test_the_episodes_of_every_row_of_a_suite_are_kept(folder: str) -> None:
    with (BENCHMARKS / folder / "results.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["suite"] in SUITES]
    expected = [
        kept_episodes(BENCHMARKS / folder, suite, name_of(suite, env, label, int(seed)))
        for suite, env, label, seed in ((r["suite"], r["env"], r["label"], r["seed"]) for r in rows)
    ]
    assert expected
    assert [file for file in expected if not file.exists()] == []


def test_only_the_named_labels_are_drawn(tmp_path: Path) -> None:
    """A label whose episodes are of no use fails where it is named, and is not read where not."""
    _keep(tmp_path, "off-policy", 0, [1.0, 2.0, 3.0])
    _keep(tmp_path, "off-policy-k1", 0, [])
    picture = tmp_path / "picture.png"
    curves(tmp_path, SUITE, ["off-policy"], picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match=r"off-policy-k1-100000-0.csv.gz: no episode has ended"):
        curves(tmp_path, SUITE, ["off-policy", "off-policy-k1"], picture)
