"""Mistakes in an environment: one line with what was found, what was expected, and where."""

import inspect
import re
import sys
from pathlib import Path

import a2s_case_envs
import pytest
from a2s_case_mistakes import RAISED, RESETS, STEPS, line_of
from case_plays import action

from a2s.actors.environments.environment import Environment
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError, FaultyEnvironmentError

FILE = r"\((?:\S*/)?a2s_case_(?:envs|mistakes)\.py:(\d+)\)"


def _make(name: str) -> Environment:
    return Environment(EnvConfig(env_id=f"a2s_case_mistakes:{name}-v0"))


def _step(name: str) -> None:
    environment = _make(name)
    environment.reset(seed=1)
    environment.step(action(0.5))


def _one_line(error: pytest.ExceptionInfo[FaultyEnvironmentError], name: str, said: str) -> int:
    """Expect a line, and give the number of the line that it names."""
    words = str(error.value)
    found = re.fullmatch(f"environment a2s_case_mistakes:{name}-v0: {said}.* {FILE}", words)
    assert found, words
    return int(found[1])


def _lines(function: object) -> range:
    assert inspect.isfunction(function)
    code, first = inspect.getsourcelines(function)
    return range(first, first + len(code))


@pytest.mark.parametrize(("name", "said"), [(name, said) for name, (_, said) in STEPS.items()])
def test_what_step_returns_wrongly_is_said_in_one_line(name: str, said: str) -> None:
    environment = _make(name)
    environment.reset(seed=1)
    with pytest.raises(FaultyEnvironmentError) as error:
        environment.step(action(0.5))
    assert _one_line(error, name, said) in _lines(a2s_case_envs.Changed.step)


@pytest.mark.parametrize(("name", "said"), [(name, said) for name, (_, said) in RESETS.items()])
def test_what_reset_returns_wrongly_is_said_in_one_line(name: str, said: str) -> None:
    with pytest.raises(FaultyEnvironmentError) as error:
        _make(name).reset(seed=1)
    assert _one_line(error, name, said) in _lines(a2s_case_envs.Changed.reset)


@pytest.mark.parametrize(("how", "said"), RAISED.items())
@pytest.mark.parametrize("where", ["make", "reset", "step"])
def test_what_is_raised_is_said_with_the_line_of_the_users_file(
    where: str, how: str, said: str
) -> None:
    """Not with the line of numpy in which it was raised, and an exit is no exit of ours."""
    name = f"Failing{where.capitalize()}{''.join(how.title().split())}"
    with pytest.raises(FaultyEnvironmentError) as error:
        _step(name)
    assert _one_line(error, name, f"{where} raised {said}") == line_of(how)


def test_an_argument_that_is_not_given_is_said_with_its_name() -> None:
    with pytest.raises(FaultyEnvironmentError) as error:
        _make("NeedsPath")
    assert re.match(
        r"environment a2s_case_mistakes:NeedsPath-v0: make raised TypeError: .*'path'",
        str(error.value),
    )
    assert "\n" not in str(error.value)


def test_what_is_raised_may_be_no_exception_of_the_usual_kind() -> None:
    """Ctrl-C does not reach the process of an environment: it has raised this itself."""
    with pytest.raises(FaultyEnvironmentError, match=r"reset raised KeyboardInterrupt"):
        _make("FailingResetInterrupt").reset(seed=1)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("class Env(\n    pass\n", r"SyntaxError: .*\((?:\S*/)?broken\.py.*\d\)"),
        ("\n1 / 0\n", r"ZeroDivisionError: division by zero \((?:\S*/)?broken\.py:2\)"),
        ("import no_such_thing\n", r"No module named 'no_such_thing'"),
        ("class Env:\n    pass\n", r"Env"),
    ],
)
def test_a_module_that_cannot_be_used_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, said: str
) -> None:
    (tmp_path / "broken.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    with pytest.raises(A2SError) as error:
        Environment(EnvConfig(env_id="broken:Env"))
    assert re.match("environment .?broken:Env", str(error.value))
    assert re.search(said, str(error.value))
    assert "\n" not in str(error.value)
