"""A replay directory: its files, who may write to them, and how they come to another capacity.

``replay.json`` names the files that count, and is replaced in one step: a directory is always of
the old capacity or of the new one, whatever is killed.
"""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import Self

from a2s.learner.replay.columns import Columns
from a2s.learner.replay.description import Description
from a2s.learner.replay.files import MappedArray
from a2s.learner.replay.index import Index
from a2s.learner.replay.record import Record
from a2s.learner.replay.records import Records
from a2s.learner.replay.ring import Ring, num_slots
from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Array


class Store:
    """The files of one replay.

    Args:
        path: The directory.
        about: What is in it.
        writable: Open them for writing.
        new: Make them.

    Attributes:
        about: What is in it.
        slots: The transitions.
        priority: One number a slot, ``[num_slots]``.

    Raises:
        RunDirectoryError: A file cannot be made, is missing or damaged.
    """

    def __init__(
        self, path: Path, about: Description, *, writable: bool, new: bool = False
    ) -> None:
        self.path = path
        self.about = about
        self._mapped: list[MappedArray] = []

        def make(name: str, shape: tuple[int, ...]) -> Array:
            mapped = MappedArray(self._file(name), shape, new=new, writable=writable)
            self._mapped.append(mapped)
            return mapped.array

        size = num_slots(about.capacity)
        try:
            self.slots = Columns.make(about.spaces, size, make)
            self.priority = make("priority", (size,))
        except RunDirectoryError:
            if new:
                self.delete()
            raise

    @classmethod
    def make(cls, path: Path, about: Description) -> Self:
        """Make the files; they count once ``replay.json`` names them.

        Raises:
            RunDirectoryError: There is no room for them.
        """
        for left in path.glob(f"*-{about.files}.*"):  # by a process that was killed here
            left.unlink()
        return cls(path, about, writable=True, new=True)

    def index(self, size: int) -> Index:
        """Open the index for appending behind its first ``size`` bytes."""
        return Index(self._file("index"), size)

    def restore(
        self, is_known: Callable[[str, int], bool] | None = None
    ) -> tuple[Ring, Records, list[Record]]:
        """Make live what the index vouches for.

        Returns:
            The rows, the records that count, and those of live rows.
        """
        ring = Ring(self.about.capacity, self.slots)
        records = Records(self._file("index"))
        if is_known is not None:
            records.cut(is_known)

        def checksum(record: Record) -> int:
            return ring.stretch(record.row, record.steps).checksum()

        live = records.verify(self.about.capacity, checksum)
        ring.restore(records.numbers, live, records.next_row)
        return ring, records, live

    def flush(self) -> None:
        """Write the rows to the disk, for the case that the machine dies."""
        for mapped in self._mapped:
            mapped.flush()

    def delete(self) -> None:
        """Delete the files: those of another capacity took their place."""
        for file in self.path.glob(f"*-{self.about.files}.*"):
            file.unlink()

    def _file(self, kind: str) -> Path:
        suffix = "log" if kind == "index" else "f32"
        return self.path / f"{kind}-{self.about.files}.{suffix}"


def lock(path: Path, *, to_read: bool = False) -> int:
    """Keep writers out until the returned descriptor is closed, or this process ends.

    Args:
        path: The directory.
        to_read: Let others keep them out as well; else only one process can, which may write.

    Raises:
        RunDirectoryError: Another process writes there, or keeps writers out.
    """
    access, kind = (os.O_RDONLY, fcntl.LOCK_SH) if to_read else (os.O_RDWR, fcntl.LOCK_EX)
    try:
        file = os.open(path / "lock", access | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise RunDirectoryError(f"replay {path}: {error.strerror}") from None
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise RunDirectoryError(
            f"replay {path}: a learner writes to it; name its run, with --connect, instead"
            if to_read
            else f"replay {path}: another learner writes to it, or learns from it; stop that first"
        ) from None
    return file
