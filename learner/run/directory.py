"""The directory of a run with all its files. ``docs/run-directory.md`` lists them."""

import contextlib
import csv
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from a2s.learner.run.growing_table import (
    GrowingTable,
    header,
    keep_rows,
    open_table,
    reading,
    whole_lines,
)
from a2s.learner.run.writing import open_lines, write_atomically, writing
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.generations import MAX_STARTS

EPISODE_COLUMNS = (
    "wall_s",
    "env_steps",
    "actor",
    "weights_version",
    "return",
    "length",
    "terminated",
)
EVALUATION_COLUMNS = (
    "wall_s",
    "env_steps",
    "weights_version",
    "mode",
    "episodes",
    "return_mean",
    "return_std",
    "return_min",
    "return_max",
    "length_mean",
)
EPISODES, UPDATES, EVALUATIONS = "episodes.csv", "updates.csv", "evaluations.csv"
CONFIG = "config.toml"
ENDPOINT, LOCK = "endpoint", "lock"


@contextlib.contextmanager
def claimed(path: Path, taken: str = "another learner is at work there; stop it") -> Iterator[None]:
    """Keep other learners out of a directory while the block lasts.

    ``taken`` says that one is in there, and what to do.

    Raises:
        RunDirectoryError: Another one is at work there, or the directory cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        file = (path / LOCK).open("a")
    except OSError as error:
        raise RunDirectoryError(f"{path}: {error.strerror}; name another --run-dir") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunDirectoryError(f"{path}: {taken}") from None
        yield


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """Write ``summary.json`` of a run directory."""
    write_atomically(path / "summary.json", json.dumps(summary, indent=2).encode())


class EvaluationRow(NamedTuple):
    """An evaluation while training: when it was done, steps of its weights, and the returns."""

    wall_s: float
    env_steps: int
    mean: float
    std: float


def endpoint(path: Path) -> str:
    """Where the learner of a run listens.

    Raises:
        UsageError: The directory does not say, or no learner is at work there.
    """
    try:
        with (path / LOCK).open() as file, contextlib.suppress(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            raise UsageError(
                f"{path}: no learner is at work there; summary.json has how it ended, or it was "
                f"killed: go on with --resume --run-dir {path}"
            )
        return (path / ENDPOINT).read_text()
    except (OSError, ValueError):
        raise UsageError(
            f"{path}: is not the directory of a run with actors, no usable {ENDPOINT}"
        ) from None


class RunDirectory:
    """Files of one run, open for appending; a missing directory is made.

    ``update_columns`` are those of ``updates.csv``; an existing table keeps its own. ``clock``
    gives seconds since the run began, those before a resume included.

    Raises:
        RunDirectoryError: It cannot be written, or ``generation`` is not a number of starts.
    """

    def __init__(
        self, path: Path, update_columns: tuple[str, ...], clock: Callable[[], float]
    ) -> None:
        self.path = path
        self._clock = clock
        self._starts = _read_starts(path / "generation")
        for table in (path / EPISODES, path / UPDATES):
            if table.exists():
                header(table)  # refused before any file is open, if it cannot be read
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            self._episodes = GrowingTable(path / EPISODES, EPISODE_COLUMNS)
            self._updates = open_table(path / UPDATES, update_columns)
            self._update_columns = header(path / UPDATES)
            self._events = open_lines(path / "events.jsonl")
            self._evaluations: GrowingTable | None = None

    def episode(self, row: Sequence[object], metrics: Mapping[str, float]) -> None:
        """Append to ``episodes.csv``: the values of `EPISODE_COLUMNS` but for the first.

        Metrics of environments, by their columns, come after these.
        """
        with writing(self.path / EPISODES):
            self._episodes.append([f"{self._clock():.3f}", *row], metrics)

    def read_episodes(self) -> Iterator[tuple[float, float, int, dict[str, float]]]:
        """Yield time, return, length and metrics of every episode so far.

        Raises:
            RunDirectoryError: A line is not one of this table; all files are closed.
        """
        try:
            yield from _episodes(self.path / EPISODES, self._episodes)
        except RunDirectoryError:
            self.close()
            raise

    def count_start(self) -> int:
        """Count one more start of the learner; the first is 1."""
        self._starts += 1
        write_atomically(self.path / "generation", str(self._starts).encode())
        return self._starts

    def update(self, row: Mapping[str, object]) -> None:
        """Append to ``updates.csv``.

        Raises:
            RunDirectoryError: It cannot be written, or the directory is not there any more.
        """
        self._require_there()
        with writing(self._updates.name):
            values = [_short(row.get(column)) for column in self._update_columns]
            csv.writer(self._updates).writerow(values)

    def keep_updates(self, count: int) -> None:
        """Forget rows of ``updates.csv`` past this many: they will be made again."""
        with writing(self.path / UPDATES):
            self._updates.close()
            keep_rows(self.path / UPDATES, count)
            self._updates = open_table(self.path / UPDATES, self._update_columns)

    def keep_episodes(self, count: int) -> None:
        """Forget rows of ``episodes.csv`` past this many: they come again."""
        with writing(self.path / EPISODES):
            self._episodes.keep(count)

    def evaluation(self, row: Sequence[object], metrics: Mapping[str, float]) -> None:
        """Append to ``evaluations.csv``: the values of `EVALUATION_COLUMNS` but for the first.

        Metrics of environments, by their columns, come after these.
        """
        path = self.path / EVALUATIONS
        with writing(path):
            if self._evaluations is None:
                self._evaluations = GrowingTable(path, EVALUATION_COLUMNS)
            self._evaluations.append([f"{self._clock():.3f}", *row], metrics)

    def read_evaluations(self, mode: str) -> list[EvaluationRow]:
        """Every evaluation in a mode so far.

        Raises:
            RunDirectoryError: A line is not one of this table; all files are closed.
        """
        try:
            return evaluations(self.path, mode)
        except RunDirectoryError:
            self.close()
            raise

    def event(self, kind: str, **details: object) -> None:
        """Append to ``events.jsonl``."""
        stamp = {"wall_s": round(self._clock(), 3), "time": round(time.time(), 3), "event": kind}
        with writing(self._events.name):
            self._events.write(json.dumps(stamp | details) + "\n")

    def policy(self, place: str, graph: bytes) -> None:
        """Write ``PLACE/policy.onnx``, for example ``latest/policy.onnx``."""
        write_atomically(self.path / place / "policy.onnx", graph)

    def close(self) -> None:
        """Close the files, whether or not what is left of their last lines can be written.

        Raises:
            RunDirectoryError: It cannot.
        """
        with contextlib.ExitStack() as stack:
            for file in (self._episodes, self._updates, self._events, self._evaluations):
                if file is not None:
                    stack.enter_context(writing(self.path))
                    stack.callback(file.close)

    def _require_there(self) -> None:
        with contextlib.suppress(OSError):
            there = os.stat(self._events.name)
            if os.path.samestat(there, os.fstat(self._events.fileno())):
                return
        raise RunDirectoryError(
            f"{self.path}: was deleted or moved while the run went on, and nothing more can be "
            "kept; where it is now, --resume goes on with it"
        )


def evaluations(path: Path, mode: str) -> list[EvaluationRow]:
    """Read ``evaluations.csv`` of a run directory, if there is one, as `read_evaluations` does.

    Raises:
        RunDirectoryError: A line is not one of this table.
    """
    table = path / EVALUATIONS
    if not table.exists():
        return []
    found = []
    with reading(table), table.open(newline="") as file:
        rows = csv.DictReader(whole_lines(file))
        try:
            for row in rows:
                each = EvaluationRow(
                    float(row["wall_s"]), int(row["env_steps"]), float(row["return_mean"]),
                    float(row["return_std"]),
                )  # fmt: skip
                if row["mode"] == mode:
                    found.append(each)
        except UnicodeDecodeError:
            raise
        except (KeyError, TypeError, ValueError, csv.Error):
            raise RunDirectoryError(
                f"{table} line {rows.line_num}: expected {','.join(EVALUATION_COLUMNS)}; mend it, "
                "or begin another run"
            ) from None
    return found


def _episodes(
    path: Path, table: GrowingTable
) -> Iterator[tuple[float, float, int, dict[str, float]]]:
    columns, line = table.columns, list[str]()
    with reading(path), path.open(newline="") as file:
        lines = csv.reader(file)
        try:
            for line in lines:
                if lines.line_num > 1:
                    row = dict(zip(columns, line, strict=True))
                    told = {n: float(row[n]) for n in table.metrics if row[n]}
                    yield float(row["wall_s"]), float(row["return"]), int(row["length"]), told
                elif line != columns:
                    raise ValueError
        except UnicodeDecodeError:
            raise
        except (ValueError, csv.Error):
            raise RunDirectoryError(
                f"{path} line {lines.line_num}: found {','.join(line)!r}, expected "
                f"{','.join(columns)}; mend it, or begin another run"
            ) from None


def _read_starts(path: Path) -> int:
    try:
        starts = int(path.read_text()) if path.exists() else 0
        if not 0 <= starts < MAX_STARTS:
            raise ValueError
    except ValueError:
        raise RunDirectoryError(
            f"{path}: found {path.read_text(errors='replace')!r}, expected how often the run was "
            "started; write that number there"
        ) from None
    except OSError as error:
        raise RunDirectoryError(
            f"{path}: {error.strerror}, expected a file with how often the run was started; write "
            "that number there"
        ) from None
    return starts


def _short(value: object) -> object:
    return f"{value:.9g}" if isinstance(value, float) else value
