"""Environments that are wrong, each in one way; importing this module registers them."""

import os
import sys
from collections.abc import Callable

import numpy as np
from a2s_case_envs import Change, Changed, Control, Obs, Step, register


class Failing(Control):
    """Fails where and in the way that it is told."""

    def __init__(self, where: str, how: str) -> None:
        super().__init__()
        self._where, self._how = where, how
        self._fail("make")

    def _fail(self, where: str) -> None:
        if where == self._where:
            _FAILURES[self._how]()

    def begin(self) -> Obs:
        self._fail("reset")
        return super().begin()

    def step(self, action: Obs) -> Step:
        self._fail("step")
        return super().step(action)


class NeedsPath(Control):
    """Its constructor wants an argument."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path


class Words:
    """Looks like a table: its repr has two lines."""

    def __repr__(self) -> str:
        return "Words(\n a, b)"


def _raise(error: BaseException) -> None:
    raise error


# The ways in which people's code fails; the comments say which line of this file it is.
_FAILURES: dict[str, Callable[[], object]] = {
    "no file": lambda: open("x.xml"),  # noqa: SIM115  # line: no file
    "key": lambda: dict[str, int]()["gripper"],  # line: key
    "deep": lambda: np.linalg.inv(np.zeros((2, 2))),  # line: deep
    "exit": lambda: sys.exit(3),  # line: exit
    "input": lambda: input("your name? "),  # line: input
    "two lines": lambda: _raise(ValueError("the first line\nthe second")),
    "no words": lambda: _raise(AssertionError()),
    "interrupt": lambda: _raise(KeyboardInterrupt()),
    "abort": os.abort,
}


def line_of(how: str) -> int:
    """The line of this file that fails in this way, or raises what fails."""
    with open(__file__) as file:
        lines = {line.rstrip(): i for i, line in enumerate(file, 1)}
    marked = [i for line, i in lines.items() if line.endswith(f"# line: {how}")]
    return marked[0] if marked else lines["    raise error"]


# What is said of each, after the name of the environment and before the file.
STEPS: dict[str, tuple[Change, str]] = {
    "FourValues": (
        lambda s: (s[0], s[1], s[2], s[4]),
        r"step returned 4 values, expected 5 \(obs, reward, terminated, truncated, info\)",
    ),
    "SixValues": (lambda s: (*s, None), r"step returned 6 values, expected 5"),
    "OnlyObs": (lambda s: s[0], r"step returned .*expected .*\(obs, reward, terminated"),
    "Nothing": (lambda s: None, r"step returned None, expected .*\(obs, reward, terminated"),
    "VectorReward": (
        lambda s: (s[0], np.array([s[1], s[1]]), *s[2:]),
        r"step returned a reward of shape \(2,\), expected a number",
    ),
    "ReprOfTwoLines": (
        lambda s: (s[0], Words(), *s[2:]),
        r"step returned a reward of Words\( a,.*expected a number",
    ),
    "NoReward": (lambda s: (s[0], None, *s[2:]), r"step returned .*None.*expected a number"),
    "WordReward": (lambda s: (s[0], "good", *s[2:]), r"step returned .*good.*expected a number"),
    "Longer": (
        lambda s: (np.append(s[0], np.float32(0)), *s[1:]),
        r"step returned an observation of 4 numbers, expected 3",
    ),
    "Twice": (
        lambda s: (np.append(s[0], s[0]), *s[1:]),
        r"step returned an observation of 6 numbers, expected 3",
    ),
    "Shorter": (
        lambda s: (s[0][:2], *s[1:]), r"step returned an observation of 2 numbers, expected 3",
    ),
    "DictOfIt": (
        lambda s: ({"state": s[0]}, *s[1:]),
        r"step returned an observation \{'state': .*expected 3",
    ),
    "NoObs": (lambda s: (None, *s[1:]), r"step returned .*None.*expected"),
    "Ragged": (
        lambda s: ([[0.0], [1.0, 2.0]], *s[1:]), r"step returned an observation .*expected",
    ),
    "NoEnd": (
        lambda s: (*s[:2], None, *s[3:]), r"step returned .*terminated.*None.*expected",
    ),
    "VectorEnd": (
        lambda s: (*s[:2], np.array([True, False]), *s[3:]),
        r"step returned .*terminated.*expected",
    ),
}  # fmt: skip
RESETS: dict[str, tuple[Change, str]] = {
    "ResetOnlyObs": (lambda r: r[0], r"reset returned .*no info, expected \(obs, info\)"),
    "ResetNothing": (lambda r: None, r"reset returned None.*, expected \(obs, info\)"),
    "ResetThree": (lambda r: (*r, 0.0), r"reset returned 3 values, expected .*\(obs, info\)"),
    "ResetLonger": (
        lambda r: (np.append(r[0], np.float32(0)), {}),
        r"reset returned an observation of 4 numbers, expected 3",
    ),
    "ResetDict": (
        lambda r: ({"state": r[0]}, {}), r"reset returned an observation \{'state': .*expected 3",
    ),
}  # fmt: skip
RAISED = {
    "no file": r"FileNotFoundError: \[Errno 2\] No such file or directory: 'x\.xml'",
    "key": r"KeyError: 'gripper'",
    "deep": r"LinAlgError: Singular matrix",
    "two lines": r"ValueError: the first line",
    "no words": r"AssertionError",
    "exit": r"SystemExit: 3",
}
for _name, (_change, _) in STEPS.items():
    register(_name, Changed, step=_change)
for _name, (_change, _) in RESETS.items():
    register(_name, Changed, reset=_change)
register("FourValuesLater", Changed, step=STEPS["FourValues"][0], at=330)
for _how in _FAILURES:
    for _where in ("make", "reset", "step"):
        _name = f"Failing{_where.title()}{_how.title().replace(' ', '')}"
        register(_name, Failing, where=_where, how=_how)
register("NeedsPath", NeedsPath)
