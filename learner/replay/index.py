"""The index of a replay: one record for each piece of a segment, appended after its rows.

A piece counts once its record is written, and then survives the death of this process.
"""

import os
import struct
import zlib
from bisect import bisect_right
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from a2s.learner.run.writing import write_at, write_atomically, writing
from a2s.protocol.errors import RunDirectoryError

TERMINATED, TRUNCATED, STARTS, CONTINUES = 1, 2, 4, 8

_PACKED = struct.Struct("<qqqqiiB7xQ96s")
_ROW_AND_STEPS = struct.Struct("<q28xi")
_CHECKSUM = struct.Struct("<I")
RECORD_BYTES = _PACKED.size + _CHECKSUM.size
_MIN_COMPACTED_BYTES = 4096 * RECORD_BYTES


class Record(NamedTuple):
    """Consecutive rows of one segment; a segment that is long or wraps round has several.

    Attributes:
        previous: Row of the step before in the same episode; -1 when it is not known.
        episode_length: Steps since the episode began, those of this record included.
        flags: Sum of ``TERMINATED`` and ``TRUNCATED`` (how the last row ends the episode),
            ``STARTS`` (the first row begins one), ``CONTINUES`` (the segment has more records).
        rows_hash: XXH3 of the rows' bytes, 64 bits.
    """

    row: int
    previous: int
    seq: int
    episode_length: int
    env: int
    steps: int
    flags: int
    rows_hash: int
    actor: str

    @property
    def end(self) -> int:
        """Number of the row after the last."""
        return self.row + self.steps

    def pack(self) -> bytes:
        """Encode it, followed by its CRC-32."""
        data = _PACKED.pack(*self[:-1], self.actor.encode())
        return data + _CHECKSUM.pack(zlib.crc32(data))


def unpack(data: bytes, position: int) -> Record | None:
    """Decode a record; ``None`` where its checksum is not right."""
    begin = position * RECORD_BYTES
    end = begin + _PACKED.size
    (crc,) = _CHECKSUM.unpack_from(data, end)
    if zlib.crc32(data[begin:end]) != crc:
        return None
    *values, actor = _PACKED.unpack_from(data, begin)
    return Record._make((*values, actor.rstrip(b"\0").decode()))


class Index:
    """The file of records, cut to ``size`` bytes and open for appending."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self._size = size
        self._compact_at = max(_MIN_COMPACTED_BYTES, 2 * size)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            os.ftruncate(self._file, size)
        except OSError as error:
            raise RunDirectoryError(f"{path}: {error.strerror}") from None

    def append(self, data: bytes, begin: int) -> None:
        """Write packed records; now and then drop those wholly before the live row ``begin``.

        Raises:
            RunDirectoryError: The disk is full, for example; nothing has changed.
        """
        try:
            if self._size >= self._compact_at:
                self._compact(begin)
            end = write_at(self._file, data, self._size)
        except OSError as error:
            with suppress(OSError):  # what is torn there is cut when it is opened
                os.ftruncate(self._file, self._size)
            raise RunDirectoryError(
                f"{self._path}: {error.strerror}; nothing is lost, make room and resume"
            ) from None
        self._size = end

    def flush(self) -> None:
        """Write everything to the disk, in case the machine dies.

        Raises:
            RunDirectoryError: It cannot be written.
        """
        with writing(self._path):
            os.fsync(self._file)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _compact(self, begin: int) -> None:
        data = os.pread(self._file, self._size, 0)
        starts = range(0, self._size, RECORD_BYTES)
        dead = bisect_right(starts, begin, key=lambda i: sum(_ROW_AND_STEPS.unpack_from(data, i)))
        write_atomically(self._path, data[dead * RECORD_BYTES :])
        os.close(self._file)
        self._file = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)
        self._size = len(data) - dead * RECORD_BYTES
        self._compact_at = max(_MIN_COMPACTED_BYTES, 2 * self._size)
