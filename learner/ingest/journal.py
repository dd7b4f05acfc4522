"""The segments accepted since a checkpoint: a learner that was killed learns from them again.

Records follow each other through numbered files of a folder. A checkpoint holds the place from
which on they are not learned from yet; see docs/run-directory.md.
"""

import os
import struct
import threading
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from a2s.learner.ingest.store import Quota
from a2s.learner.run.writing import write_at, writing
from a2s.protocol.codec import decode
from a2s.protocol.errors import MalformedMessageError, RunDirectoryError
from a2s.protocol.messages import Segment

_HEAD = struct.Struct("<cII")  # kind, bytes of the body, CRC-32 of kind and body
_SEGMENT, _ROUND, _BATCH = b"S", b"R", b"B"
_SLOT, _OF_ROUND, _OF_BATCH = struct.Struct("<i"), struct.Struct("<6q"), struct.Struct("<q")


class Place(NamedTuple):
    """The end of a batch: bytes of a numbered file, and the ledger's accepted steps by then."""

    file: int = 0
    end: int = 0
    accepted_steps: int = 0


class Stored(NamedTuple):
    """An accepted segment, of the actor at a place."""

    slot: int
    segment: Segment


class Begun(NamedTuple):
    """Weights are out for a number of environments, with their quota."""

    version: int
    epoch: int
    num_envs: int
    quota: Quota


class Taken(NamedTuple):
    """All segments so far are a batch."""

    end: Place


Record = Stored | Begun | Taken


class Journal:
    """Appends to the newest file of a folder; what was appended survives the death of this process.

    Threads that answer actors append while the learner's loop begins files: one lock guards that.
    ``accepted_steps`` are those of the ledger now.

    Attributes:
        folder: Where its files are.
        place: The end of the newest batch.

    Raises:
        RunDirectoryError: The folder cannot be made or read.
    """

    def __init__(self, folder: Path, accepted_steps: int = 0) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._open(max(_numbers(folder), default=0))
        self.place = Place(self._number, self._size, accepted_steps)

    def segment(self, slot: int, payload: bytes) -> None:
        """Write an accepted segment down, as it came over the network.

        Raises:
            RunDirectoryError: There is no room for it; so do the others.
        """
        self._append(_SEGMENT, _SLOT.pack(slot) + payload)

    def begin(self, begun: Begun) -> None:
        """Weights are out."""
        *of_weights, quota = begun
        self._append(_ROUND, _OF_ROUND.pack(*of_weights, *quota))

    def take(self, accepted_steps: int) -> None:
        """All that was written is a batch."""
        number, size = self._append(_BATCH, _OF_BATCH.pack(accepted_steps))
        self.place = Place(number, size, accepted_steps)

    def roll(self, oldest: Place) -> None:
        """Begin a file, and delete those before a place: no checkpoint needs them."""
        with self._lock, writing(self.folder):
            full = self._file
            if self._size:
                self._open(self._number + 1)
                os.close(full)
            for number in _numbers(self.folder):
                if number < oldest.file:
                    _path(self.folder, number).unlink()

    def cut(self, size: int) -> None:
        """Cut what a kill has torn: the newest file is whole up to this byte.

        Raises:
            RunDirectoryError: The file cannot be written.
        """
        with writing(self.folder):
            os.ftruncate(self._file, size)
        self._size = size

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _append(self, kind: bytes, body: bytes) -> tuple[int, int]:
        """Write a record; gives the file, and its size now."""
        head = _HEAD.pack(kind, len(body), zlib.crc32(body, zlib.crc32(kind)))
        with self._lock, writing(self.folder):
            self._size = write_at(self._file, head + body, self._size)
            return self._number, self._size

    def _open(self, number: int) -> None:
        self._file = os.open(_path(self.folder, number), os.O_WRONLY | os.O_CREAT, 0o644)
        self._number, self._size = number, os.fstat(self._file).st_size


def has(folder: Path, place: Place) -> bool:
    """Whether the records from a place on are there."""
    path = _path(folder, place.file)
    return path.exists() and path.stat().st_size >= place.end


def read(folder: Path, place: Place) -> tuple[list[Record], int]:
    """Read the records after a place, and to which byte the newest file is whole.

    Raises:
        RunDirectoryError: A record is damaged, or cannot be read.
    """
    records: list[Record] = []
    begin, numbers = place.end, [n for n in _numbers(folder) if n >= place.file]
    for number in numbers:
        begin = place.end if number == place.file else 0
        try:
            data = _path(folder, number).read_bytes()
        except OSError as error:
            raise RunDirectoryError(f"{_path(folder, number)}: {error.strerror}") from None
        while begin < len(data):
            end, record = _record(data, begin, number)
            if record is None:
                if end == len(data) and number == numbers[-1]:
                    break  # torn by a kill
                raise RunDirectoryError(
                    f"{_path(folder, number)}: the checksum of the record at byte {begin} does not "
                    f"match; {advice(folder)}"
                )
            records.append(record)
            begin = end
    return records, begin


def without(place: Place, accepted_steps: int) -> str:
    """What is lost where a journal does not go on from a place; these steps are the ledger's."""
    words = "is not there any more, or does not go on from the checkpoint"
    since = accepted_steps - place.accepted_steps
    if since > 0:
        return f"{words}; the {since:,} steps since then count and are not learned from"
    if since < 0:
        return (
            f"{words}; segments.log has {-since:,} steps fewer than that, what is lost is unknown"
        )
    return f"{words}; nothing came after that, and nothing is lost"


def require_all(folder: Path, missing: int) -> None:
    """Require that no steps are missing which the ledger knows.

    Raises:
        RunDirectoryError: So many are.
    """
    if missing > 0:
        raise RunDirectoryError(
            f"{folder}: {missing} steps fewer than in segments.log; restore whichever of the two "
            f"is damaged, or {advice(folder)}"
        )


def num_steps(records: Iterable[Record]) -> int:
    """Steps of the segments that were stored."""
    return sum(record.segment.num_steps for record in records if isinstance(record, Stored))


def advice(folder: Path) -> str:
    """How to go on without a journal."""
    return f"delete {folder} to go on from the checkpoint, without the steps since then"


def _record(data: bytes, begin: int, number: int) -> tuple[int, Record | None]:
    """Read the record at a byte of a file: its end, and ``None`` if it is torn or damaged."""
    if begin + _HEAD.size > len(data):
        return len(data), None
    kind, size, crc = _HEAD.unpack_from(data, begin)
    end = begin + _HEAD.size + size
    body = data[begin + _HEAD.size : end]
    if len(body) < size or zlib.crc32(body, zlib.crc32(kind)) != crc:
        return min(end, len(data)), None
    try:
        if kind == _SEGMENT:
            (slot,) = _SLOT.unpack_from(body)
            return end, Stored(slot, decode(body[_SLOT.size :], Segment))
        if kind == _ROUND:
            version, epoch, num_envs, *quota = _OF_ROUND.unpack(body)
            return end, Begun(version, epoch, num_envs, Quota(*quota))
        return end, Taken(Place(number, end, *_OF_BATCH.unpack(body)))
    except (struct.error, MalformedMessageError):
        return end, None


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08d}"


def _numbers(folder: Path) -> list[int]:
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())
