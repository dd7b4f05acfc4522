"""The command line, run in the process of the test; a replay on disk."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from replay_oracle import ENV_ID, SPACES, Oracle

from a2s import cli
from a2s.learner.replay import directory


@pytest.fixture
def a2s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run ``a2s`` in an empty directory: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["a2s", *map(str, arguments)])
        for name in ("unraisablehook", "stdout", "stderr"):  # which it replaces
            monkeypatch.setattr(sys, name, getattr(sys, name))
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0), *capsys.readouterr()

    return run


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A run directory with a replay of two streams, that have lost segments and evicted rows."""
    replay = directory.create(tmp_path / "run" / "replay", ENV_ID, SPACES, 24)
    oracle = Oracle(24)
    for actor, steps, end, lost in (
        ("a", 5, "", False),  # rows 0 to 4: evicted in part
        ("b", 2, "", False),
        ("a", 3, "terminated", False),  # its first step is no longer there
        ("a", 4, "", False),  # rows 10 to 13
        ("b", 3, "truncated", False),  # rows 14 to 16, after 5 and 6
        ("a", 2, "truncated", False),  # rows 17 and 18
        ("b", 2, "", False),
        ("b", 2, "", True),
        ("b", 2, "terminated", False),  # a segment is lost
        ("a", 3, "terminated", False),  # rows 23 to 25
        ("b", 1, "", False),  # not over
    ):
        segment = oracle.play(actor, 0, steps, end, lost=lost)
        if not lost:
            replay.insert(segment)
    assert replay.live == range(3, 27)
    replay.close()
    return tmp_path / "run"
