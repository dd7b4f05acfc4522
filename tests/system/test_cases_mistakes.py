"""A mistake in an environment ends a command at once, with one line that says what to mend."""

import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from a2s_case_mistakes import line_of
from case_runs import SMALL, a2s, events

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

FILE = r" \((?:\S*/)?a2s_case_(?:envs|mistakes)\.py:\d+\)"
FOUR = r"step returned 4 values, expected 5 \(obs, reward, terminated, truncated, info\)" + FILE


def _at(how: str) -> str:
    return rf" \((?:\S*/)?a2s_case_mistakes\.py:{line_of(how)}\)"


@pytest.mark.parametrize(
    ("env", "options", "said"),
    [
        (
            "a2s_case_mistakes:FailingMakeNoFile-v0", (),
            r"make raised FileNotFoundError: \[Errno 2\] No such file or directory: 'x\.xml'"
            + _at("no file"),
        ),
        (
            "a2s_case_mistakes:FailingResetInput-v0", (),
            "reset raised EOFError: EOF when reading a line" + _at("input"),
        ),
        ("a2s_case_mistakes:FailingResetAbort-v0", (), r".*SIGABRT in reset of environment 0"),
        (
            "a2s_case_processes:HangsAlways-v0",
            ("--env-kwargs", "where=reset", "--env-timeout", "2"),
            r"reset .*had not returned after 2 s.*",
        ),
        pytest.param(
            "a2s_case_processes:HangsAlways-v0",
            ("--env-kwargs", "where=make", "--env-timeout", "2"),
            r"make .*had not returned after 2 s.*",
            marks=pytest.mark.long,
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_made_or_reset_is_said_in_one_line(
    tmp_path: Path, env: str, options: tuple[str, ...], said: str
) -> None:
    done = a2s("check", env, *options, cwd=tmp_path)
    assert done.code == 1, done.err
    assert re.fullmatch(f"a2s: environment {env}: {said}", done.last), done.err
    assert "Traceback" not in done.err + done.out


def test_a_training_finds_it_before_anything_starts(tmp_path: Path) -> None:
    env = "a2s_case_mistakes:FailingResetInput-v0"
    done = a2s("train", "--env", env, *SMALL, "--run-dir", "run", cwd=tmp_path)
    assert done.code == 1, done.err
    (line,) = (line for line in done.err.splitlines() if "a2s: " in line)
    said = "reset raised EOFError: EOF when reading a line" + _at("input")
    assert re.fullmatch(f"a2s: environment {env}: {said}", line), done.err
    assert "Traceback" not in done.err + done.out
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("call", [pytest.param("reset", marks=pytest.mark.long), "step"])
def test_an_evaluation_says_it_too(
    tmp_path: Path, make_graph: Callable[..., bytes], call: str
) -> None:
    """Of a policy that was trained elsewhere, for example."""
    (tmp_path / "policy.onnx").write_bytes(make_graph(obs_size=3, low=(-1.0,), high=(1.0,)))
    env = f"a2s_case_mistakes:Failing{call.capitalize()}Key-v0"
    done = a2s("evaluate", "policy.onnx", "--env", env, cwd=tmp_path)
    assert done.code == 1, done.err
    said = f"a2s: environment {env}: {call} raised KeyError: 'gripper'{_at('key')}"
    assert re.fullmatch(said, done.last), done.err
    assert "Traceback" not in done.err + done.out


@pytest.mark.long
def test_a_mistake_in_a_step_ends_a_training_at_once(tmp_path: Path) -> None:
    """Also one that comes after an update; nothing is tried again."""
    env, begin_s = "a2s_case_mistakes:FourValuesLater-v0", time.monotonic()
    done = a2s("train", "--env", env, *SMALL, "--run-dir", "run", cwd=tmp_path)
    assert done.code == 1, done.err
    assert re.match(f"a2s: environment {env}: {FOUR}", done.last), done.err
    assert "Traceback" not in done.err + done.out + (tmp_path / "run" / "actors.log").read_text()
    assert "died" not in done.err
    assert events(tmp_path / "run", "restart") == []
    assert time.monotonic() - begin_s < 60


def test_spaces_that_cannot_be_used_are_exit_code_2(tmp_path: Path) -> None:
    env = "a2s_case_numbers:Widest-v0"
    done = a2s("check", env, cwd=tmp_path)
    assert done.code == 2, done.err
    (line,) = done.err.splitlines()
    bounds = r"action 0 has bounds -3\.40282e\+38 to 3\.40282e\+38"
    assert re.match(f"a2s: environment {env}: {bounds}", line)
