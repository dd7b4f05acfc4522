"""A CSV table whose columns grow: metrics of environments are known when they come."""

import csv
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from a2s.learner.run.writing import open_lines, write_atomically
from a2s.protocol.checks import MAX_METRICS
from a2s.protocol.errors import RunDirectoryError


class GrowingTable:
    """Rows with fixed columns and, after these, one for each metric from the first row that has it.

    Attributes:
        metrics: Names of the columns of metrics so far.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self._file = open_table(path, columns)
        self.metrics = header(path)[len(columns) :]

    @property
    def columns(self) -> list[str]:
        """All columns, in their order."""
        return [*self._columns, *self.metrics]

    def append(self, row: Sequence[object], metrics: Mapping[str, float]) -> None:
        """Append a row; so many metrics that the table would be too wide are left out."""
        unknown = [name for name in metrics if name not in self.metrics]
        if added := unknown[: MAX_METRICS - len(self.metrics)]:
            self._add_columns(added)
        told = [f"{metrics[name]:.9g}" if name in metrics else "" for name in self.metrics]
        csv.writer(self._file).writerow([*row, *told])

    def keep(self, count: int) -> None:
        """Forget the rows past this many; columns stay."""
        self._file.close()
        keep_rows(self._path, count)
        self._file = open_table(self._path, self._columns)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add_columns(self, names: list[str]) -> None:
        """Write the table anew with more columns, empty so far."""
        self._file.close()
        with reading(self._path), self._path.open(newline="") as file:
            first, *lines = list(csv.reader(file))
        text = io.StringIO(newline="")
        csv.writer(text).writerows(
            [[*first, *names], *([*line, *("" for _ in names)] for line in lines)]
        )
        write_atomically(self._path, text.getvalue().encode())
        self.metrics += names
        self._file = open_table(self._path, self._columns)


def open_table(path: Path, columns: Sequence[str]) -> IO[str]:
    """Open a table for appending."""
    file = open_lines(path)
    if not file.tell():
        csv.writer(file).writerow(columns)
    return file


def keep_rows(path: Path, count: int) -> None:
    """Forget the rows of a closed table past this many; what is kept stays to the byte."""
    lines = path.read_bytes().splitlines(keepends=True)
    write_atomically(path, b"".join(lines[: count + 1]))


def whole_lines(file: Iterable[str]) -> Iterator[str]:
    """Read a table without a line that a kill, or want of room, has torn: it is of no row."""
    return (line for line in file if line.endswith("\n"))


def header(path: Path) -> list[str]:
    """Read the columns of a table.

    Raises:
        RunDirectoryError: They cannot be read.
    """
    with reading(path), path.open("rb") as file:
        return next(csv.reader([file.readline().decode()]), [])


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Name the table when the block cannot read it.

    Raises:
        RunDirectoryError: It is not there, or has a byte that is not UTF-8.
    """
    try:
        yield
    except OSError as error:
        raise RunDirectoryError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise RunDirectoryError(
            f"{path}: found the byte 0x{error.object[error.start]:02x}, expected UTF-8; mend it, "
            "or restore it from a copy"
        ) from None


def column_of(metric: str, columns: Collection[str]) -> str:
    """Name the column of an environment's metric, different from those of the table itself."""
    return f"info_{metric}" if metric in columns else metric
