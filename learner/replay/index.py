"""The index of a replay: a record for each piece of a segment, appended when its rows are there.

What has a record survives the death of this process; what has none was never inserted.
"""

import os
from pathlib import Path

from a2s.learner.replay.record import RECORD_BYTES, numbers
from a2s.learner.run.directory import write_atomically
from a2s.protocol.errors import RunDirectoryError

_FEW_BYTES = 4096 * RECORD_BYTES


class Index:
    """The file of records, open for appending.

    Args:
        path: The file; made when it is not there.
        size: Bytes of it that count; what is behind them is cut off.

    Raises:
        RunDirectoryError: It cannot be written.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self._size = size
        self._compact_at = max(_FEW_BYTES, 2 * size)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            os.ftruncate(self._file, size)
        except OSError as error:
            raise RunDirectoryError(f"{path}: {error.strerror}") from None

    def append(self, data: bytes, begin: int) -> None:
        """Write records; they survive the death of this process when this returns.

        Args:
            data: Packed records.
            begin: The oldest live row; records wholly before it are dropped now and then.

        Raises:
            RunDirectoryError: They cannot be written, for example because the disk is full;
                nothing has changed.
        """
        try:
            if self._size >= self._compact_at:
                self._compact(begin)
            written = 0
            while written < len(data):
                written += os.pwrite(self._file, data[written:], self._size + written)
        except OSError as error:
            os.ftruncate(self._file, self._size)
            raise RunDirectoryError(
                f"{self.path}: {error.strerror}; nothing is lost, make room and resume"
            ) from None
        self._size += written

    def flush(self) -> None:
        """Write everything to the disk, for the case that the machine dies."""
        os.fsync(self._file)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _compact(self, begin: int) -> None:
        data = os.pread(self._file, self._size, 0)
        found = numbers(data)
        dead = int((found["row"] + found["steps"]).searchsorted(begin, side="right"))
        write_atomically(self.path, data[dead * RECORD_BYTES :])
        os.close(self._file)
        self._file = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        self._size = len(data) - dead * RECORD_BYTES
        self._compact_at = max(_FEW_BYTES, 2 * self._size)
