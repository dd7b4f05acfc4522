"""One line of the index: which rows a piece of a segment lies in, and their checksum."""

import struct
import zlib
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

TERMINATED, TRUNCATED, STARTS, CONTINUES = 1, 2, 4, 8

_PACKED = struct.Struct("<qqqqiiB7xQ96s")
_CHECKSUM = struct.Struct("<I")
RECORD_BYTES = _PACKED.size + _CHECKSUM.size
_NUMBERS = np.dtype(
    {
        "names": ["row", "previous", "seq", "episode_length", "env", "steps", "flags", "rows_hash"],
        "formats": ["<i8", "<i8", "<i8", "<i8", "<i4", "<i4", "u1", "<u8"],
        "offsets": [0, 8, 16, 24, 32, 36, 40, 48],
        "itemsize": RECORD_BYTES,
    }
)

Numbers = npt.NDArray[np.void]


class Record(NamedTuple):
    """Consecutive rows of one segment; a segment that is long or wraps round has several.

    Attributes:
        row: Number of its first row, counted from the first ever inserted.
        previous: Row of the step before in the same episode; -1 when it is not known.
        seq: Number of the segment.
        episode_length: Steps since the episode began, those of this record included.
        env: Index of the environment within the actor.
        steps: Rows.
        flags: Sum of ``TERMINATED`` and ``TRUNCATED`` (how the last row ends the episode),
            ``STARTS`` (the first row begins one), ``CONTINUES`` (the segment has more records).
        rows_hash: XXH3 of the rows' bytes, 64 bits.
        actor: Sender of the segment.
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
        """Make its bytes, checksum included."""
        data = _PACKED.pack(*self[:-1], self.actor.encode())
        return data + _CHECKSUM.pack(zlib.crc32(data))


def unpack(data: bytes, position: int) -> Record:
    """Read the record at a position whose checksum is known to be right."""
    values = _PACKED.unpack_from(data, position * RECORD_BYTES)
    return Record._make((*values[:-1], values[-1].rstrip(b"\0").decode()))


def numbers(data: bytes) -> Numbers:
    """Look at the numbers of all whole records at once, by the names of `Record`."""
    return np.frombuffer(data, _NUMBERS, count=len(data) // RECORD_BYTES)


def is_whole(data: memoryview, position: int) -> bool:
    """Whether the checksum of the record at a position is right."""
    begin = position * RECORD_BYTES
    end = begin + _PACKED.size
    (crc,) = _CHECKSUM.unpack_from(data, end)
    return bool(zlib.crc32(data[begin:end]) == crc)
