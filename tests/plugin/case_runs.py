"""Commands as a user starts them, to their end: what they print, and what they leave behind."""

import csv
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from system_helpers import FAST, PATIENCE_S, rows

# Without -P Python would look into the working directory first, which no installed a2s does.
A2S = (sys.executable, "-P", "-m", "a2s.cli")
SMALL = (
    *FAST, "--n", "1", "--lockstep", "--seed", "3", "--total-steps", "1000", "--episodes", "2",
    "--metrics-port", "-1",
)  # fmt: skip
OFF_POLICY = (
    "--variant", "off-policy", "--set", "critic_sizes=16,16", "--set", "policy_sizes=16,16",
    "--set", "batch_rows=32", "--set", "warm_up_steps=100", "--set", "send_every_steps=8",
    "--set", "replay_rows=20000", "--n", "1", "--envs", "2", "--lockstep", "--seed", "3",
    "--total-steps", "400", "--episodes", "2", "--metrics-port", "-1",
)  # fmt: skip


@dataclass(frozen=True)
class Ended:
    """A command that has ended.

    Attributes:
        code: Its exit code.
        out: Its standard output.
        err: Its standard error.
    """

    code: int
    out: str
    err: str

    @property
    def last(self) -> str:
        """The last line of its standard error."""
        return (self.err.strip().splitlines() or [""])[-1]


def a2s(*arguments: str, cwd: Path, **variables: str) -> Ended:
    """Run ``a2s`` to its end, with a standard input on which nobody ever types."""
    ours, theirs = os.pipe()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            [*A2S, *arguments], cwd=cwd, stdin=ours, stdout=out, stderr=err,
            env=os.environ | variables,
        )  # fmt: skip
        try:
            process.wait(PATIENCE_S)
        finally:
            process.kill()
            process.wait()
            os.close(ours)
            os.close(theirs)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    return Ended(process.returncode, *texts)


@dataclass(frozen=True)
class Trained:
    """A training that ended well.

    Attributes:
        path: Its directory.
        summary: What it printed as JSON.
        err: What else it printed.
    """

    path: Path
    summary: dict[str, Any]
    err: str

    def events(self, kind: str) -> list[dict[str, Any]]:
        """Its events of a kind."""
        return events(self.path, kind)

    def actors_log(self) -> str:
        """What its actors said."""
        return (self.path / "actors.log").read_text(errors="replace")

    def learned(self) -> tuple[list[str], list[str]]:
        """What is the same for two that learned the same: every episode, and every loss."""
        one, two = ("episodes.csv", "updates.csv")
        return rows(self.path / one, without="wall_s"), rows(self.path / two, without="wall_s")

    def episodes(self) -> list[dict[str, str]]:
        """Its episodes."""
        with (self.path / "episodes.csv").open(newline="") as file:
            return list(csv.DictReader(file))


def train(cwd: Path, env: str, *options: str, run: str = "run", **variables: str) -> Trained:
    """Train to the end; standard output is one line of JSON, whatever the environment prints."""
    where = ("--run-dir", run, "--json")  # relative, as a user gives it
    done = a2s("train", "--env", env, *options, *where, cwd=cwd, **variables)
    assert done.code == 0, done.err
    (line,) = done.out.splitlines()
    trained = Trained(cwd / run, json.loads(line), done.err)
    assert trained.summary["finished"], done.err
    assert "Traceback" not in done.err + trained.actors_log()
    return trained


def evaluate(cwd: Path, run: str, *options: str) -> dict[str, Any]:
    """Evaluate a run, or a policy file."""
    done = a2s("evaluate", run, *options, "--json", cwd=cwd)
    assert done.code == 0, done.err
    found: dict[str, Any] = json.loads(done.out)
    return found


def events(path: Path, kind: str) -> list[dict[str, Any]]:
    """The events of a kind in a run directory."""
    lines = (path / "events.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if event["event"] == kind]
