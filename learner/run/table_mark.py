"""What the tables of a run were at a checkpoint, to tell whether they still begin with that."""

import contextlib
import csv
import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import xxhash

from a2s.learner.run.directory import EPISODES, EVALUATIONS, UPDATES
from a2s.learner.run.growing_table import header
from a2s.learner.run.writing import writing

CHANGED = "is not what the checkpoint knows; its figures may differ from what was learned"
REMEDY = "restore it from a copy if that matters"
_TABLES = (EPISODES, UPDATES, EVALUATIONS)


class TableMark(NamedTuple):
    """The size of a table in bytes, their XXH3, and how many columns it has."""

    size: int
    digest: str
    columns: int


def marks_of(path: Path) -> dict[str, TableMark]:
    """What the tables in a run directory are now, by their names.

    Raises:
        RunDirectoryError: One cannot be read.
    """
    return {name: _mark(path / name) for name in _TABLES if (path / name).exists()}


def changed(path: Path, known: Mapping[str, TableMark]) -> list[str]:
    """Find the tables in a run directory that do not begin with what is known of them.

    Rows and columns may have been added.
    """
    return [name for name, mark in known.items() if not _has_kept(path / name, TableMark(*mark))]


def _mark(path: Path) -> TableMark:
    with writing(path), path.open("rb") as file:
        digest = hashlib.file_digest(file, xxhash.xxh3_64).hexdigest()
        return TableMark(file.tell(), digest, len(header(path)))


def _has_kept(path: Path, known: TableMark) -> bool:
    with contextlib.suppress(OSError, csv.Error):  # then it is another
        data = path.read_bytes()
        return any(
            xxhash.xxh3_64_hexdigest(each[: known.size]) == known.digest
            for each in (data, _narrowed(data, known.columns))
        )
    return False


def _narrowed(data: bytes, columns: int) -> bytes:
    """A table without the columns that were added to it."""
    lines = csv.reader(io.StringIO(data.decode(errors="surrogateescape"), newline=""))
    text = io.StringIO(newline="")
    csv.writer(text).writerows(line[:columns] for line in lines)
    return text.getvalue().encode(errors="surrogateescape")
