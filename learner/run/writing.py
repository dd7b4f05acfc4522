"""Writing files: whole whatever is killed, or at their end; a failure is one line."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from a2s.protocol.errors import RunDirectoryError


@contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Name the file when the block cannot write it.

    Raises:
        RunDirectoryError: There is no room, for example.
    """
    try:
        yield
    except OSError as error:
        raise RunDirectoryError(f"{path}: {error.strerror}; mend that and resume") from None


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that readers see the old or the new one, whole, whatever is killed.

    Raises:
        RunDirectoryError: It cannot be written; the old one is still there.
    """
    partial = path.with_name(path.name + ".partial")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.rename(path)


def open_lines(path: Path) -> IO[str]:
    """Open a file for appending, without a line that a kill, or want of room, has torn."""
    whole = path.read_bytes().rfind(b"\n") + 1 if path.exists() else 0
    file = path.open("a", newline="", buffering=1)
    file.truncate(whole)
    file.seek(whole)
    return file


def write_at(file: int, data: bytes, begin: int) -> int:
    """Write all of it from a byte of an open file on; gives where it ends.

    Raises:
        OSError: Not all of it could be written.
    """
    end = begin + len(data)
    while begin < end:
        begin += os.pwrite(file, data[begin - end :], begin)
    return end
