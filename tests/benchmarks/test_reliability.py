"""The trials of reliability in their short form: what they look for does not happen."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from reliability import run
from reliability.fuzz import decoded
from reliability.run import COLUMNS, TRIALS, line_of, table
from reliability.soak import line

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_mutated_messages_are_decoded_or_refused_with_a_reason() -> None:
    assert decoded(2000, seed=1).failures == []


def test_a_slope_has_an_interval() -> None:
    found = line([(i / 100, 50 + 2 * i / 100) for i in range(100)])
    assert found == pytest.approx((2.0, 2.0, 2.0))
    slope, low, high = line([(i / 100, i / 100 + i // 5 % 3) for i in range(100)])
    assert low < 1.0 < high
    assert low <= slope <= high
    momentary = line([(i / 100, 50.0 + 30.0 * (i % 7 == 0)) for i in range(100)])
    assert momentary == (0.0, 0.0, 0.0)
    once = line([(i / 100, 50.0 + 30.0 * (60 <= i < 70)) for i in range(100)])
    assert once == (0.0, 0.0, 0.0)


def test_a_result_is_a_row_that_says_whether_it_was_full_and_what_failed() -> None:
    row = dict.fromkeys(COLUMNS, "") | {
        "program": "kills", "count": "5", "failed": "1", "first_failure": "a | b", "full": "False",
    }  # fmt: skip
    last = table([row]).splitlines()[-1]
    assert "short: `kills " in last
    assert "5 times, 1 failed. first: a \\| b" in last
    assert line_of(row | {"trial": "kill"}) == "kill: 5 times, 1 failed; first: a | b"


def test_a_short_result_is_told_and_leaves_the_row_of_a_full_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = run.README.read_text()
    for name in ("RESULTS", "README"):
        kept = tmp_path / name
        shutil.copy(getattr(run, name), kept)
        monkeypatch.setattr(run, name, kept)
    monkeypatch.setitem(TRIALS, "fuzz", ("--decode 100 --live 0", ""))
    monkeypatch.setattr(sys, "argv", ["run.py", "fuzz"])
    with pytest.raises(SystemExit) as ended:
        run.main()
    assert not ended.value.code
    assert capsys.readouterr().out == "fuzz, decode: held 100 times\n"
    assert (tmp_path / "README").read_text() == before


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("program", [p for p in TRIALS if p not in ("bytes", "soak")])
def test_the_short_form_holds(program: str) -> None:
    """Not of damaged bytes: lines of the ledger have no checksum. A short soak says nothing."""
    command = [sys.executable, "-m", f"reliability.{program}", *TRIALS[program][0].split()]
    paths = os.pathsep.join([str(BENCHMARKS), os.environ["PYTHONPATH"]])
    environ = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
