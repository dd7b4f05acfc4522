"""The files of a replay directory: ``replay.json``, mapped arrays, and the lock.

``replay.json`` names the files that count, and is replaced in one step: a kill leaves a directory
of the old capacity or of the new one.
"""

import fcntl
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from a2s.learner.replay.index import Index
from a2s.learner.replay.ring import make_columns
from a2s.learner.run.writing import write_atomically, writing
from a2s.protocol.errors import MalformedMessageError, RunDirectoryError
from a2s.protocol.fields import Array, Spaces

NAME = "replay.json"
RESTORE = "restore it from a copy, or begin another run with --init-from RUN"
_FORMAT = 2

FloatMap = np.memmap[tuple[int, ...], np.dtype[np.float32]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """The contents of ``replay.json``.

    ``files`` is the number in the names of the other files; ``source`` says where the transitions
    were imported from, and is empty for those of a run.
    """

    env_id: str
    spaces: Spaces
    capacity: int
    files: int
    source: str = ""

    @property
    def index_name(self) -> str:
        """Name of the file of records."""
        return f"index-{self.files}.log"

    def write(self, path: Path) -> None:
        """Write it into a directory."""
        offset = self.spaces.obs_offset
        document = {
            "format": _FORMAT,
            "env_id": self.env_id,
            "obs_size": self.spaces.obs_size,
            "action_low": self.spaces.action_low.tolist(),
            "action_high": self.spaces.action_high.tolist(),
            "obs_offset": None if offset is None else offset.tolist(),
            "capacity": self.capacity,
            "files": self.files,
            "source": self.source,
        }
        write_atomically(path / NAME, json.dumps(document, indent=2).encode())

    def require(
        self, path: Path, env_id: str, spaces: Spaces, advice: str = "name another run directory"
    ) -> None:
        """Raise RunDirectoryError if the transitions are of another environment."""
        if self.env_id != env_id:
            raise RunDirectoryError(
                f"replay {path}: found environment {self.env_id}, expected {env_id}; {advice}"
            )
        difference = spaces.differs_from(self.spaces)
        if difference:
            raise RunDirectoryError(f"replay {path}: found {difference}; {advice}")


def describe(path: Path) -> Description:
    """Read the description of a replay directory.

    Raises:
        RunDirectoryError: The description is missing, or of another format.
    """
    try:
        document = json.loads((path / NAME).read_bytes())
        if document["format"] != _FORMAT:
            raise RunDirectoryError(
                f"replay {path}: found format {document['format']}, expected {_FORMAT}"
            )
        offset = document.get("obs_offset")
        return Description(
            env_id=str(document["env_id"]),
            spaces=Spaces(
                obs_size=int(document["obs_size"]),
                action_low=np.array(document["action_low"], np.float32),
                action_high=np.array(document["action_high"], np.float32),
                obs_offset=None if offset is None else np.array(offset, np.float32),
            ),
            capacity=int(document["capacity"]),
            files=int(document["files"]),
            source=str(document.get("source", "")),
        )
    except FileNotFoundError:
        raise RunDirectoryError(
            f"{path}: holds no replay, it has no {NAME}; off-policy runs have one"
        ) from None
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        RecursionError,
        MalformedMessageError,
    ) as error:
        raise RunDirectoryError(f"replay {path}: {NAME} is damaged ({error}); {RESTORE}") from None


class Files:
    """The open files of a replay; written data survives this process.

    With ``new`` they are made, all zeros, with all their room, so that a full disk is noticed now;
    they count once ``replay.json`` names them.

    Attributes:
        slots: The transitions.
        priority: One number a slot, float32 ``[S]``.
        index_path: The file of records.
        index: The same, once it is opened for appending.
        lock_file: The descriptor from `locked`, to be closed with the files; -1 without.

    Raises:
        RunDirectoryError: There is no room for a file, or it is missing or of another size.
    """

    def __init__(
        self, path: Path, about: Description, *, writable: bool, new: bool = False
    ) -> None:
        self._path = path
        self._number = about.files
        self._maps: list[FloatMap] = []
        self.index_path = path / about.index_name
        self.index: Index | None = None
        self.lock_file = -1

        def make(name: str, shape: tuple[int, ...]) -> Array:
            file = path / f"{name}-{about.files}.f32"
            self._maps.append(_map(file, shape, new=new, writable=writable))
            return np.asarray(self._maps[-1])  # a plain array is read faster than a map

        if new:
            self.delete()  # left by a process that was killed here
        try:
            self.slots = make_columns(about.spaces, about.capacity, make)
            self.priority = make("priority", (len(self.slots.outcome),))
        except RunDirectoryError:
            if new:
                self.delete()
            raise

    def flush(self) -> None:
        """Write the writable files to the disk, in case the machine dies.

        Raises:
            RunDirectoryError: They cannot be written.
        """
        if self.index is not None:
            with writing(self._path):
                for mapped in self._maps:
                    mapped.flush()
            self.index.flush()

    def close(self) -> None:
        """Close the index and give up the lock; the arrays can still be read."""
        if self.index is not None:
            self.index.close()
            self.index = None
        if self.lock_file >= 0:
            os.close(self.lock_file)
            self.lock_file = -1

    def delete(self) -> None:
        """Delete the files."""
        for file in self._path.glob(f"*-{self._number}.*"):
            file.unlink()


def _map(path: Path, shape: tuple[int, ...], *, new: bool, writable: bool) -> FloatMap:
    expected = 4 * math.prod(shape)
    try:
        if new:
            with path.open("xb") as file:
                os.posix_fallocate(file.fileno(), 0, expected)
        found = path.stat().st_size
        if found != expected:
            raise RunDirectoryError(f"{path}: found {found} bytes, expected {expected}; {RESTORE}")
        return np.memmap(path, np.float32, "r+" if writable else "r", shape=shape)
    except OSError as error:
        remedy = f"{expected / 2**20:.0f} MiB are needed" if new else RESTORE
        raise RunDirectoryError(f"{path}: {error.strerror}; {remedy}") from None


@contextmanager
def locked(path: Path, *, to_read: bool = False) -> Iterator[int]:
    """Keep writers out until the descriptor is closed, which this does only after an error.

    Only one process can hold it, and may write; with ``to_read`` several can, and must not write.

    Raises:
        RunDirectoryError: Another process writes there, or keeps writers out.
    """
    access, kind = (os.O_RDONLY, fcntl.LOCK_SH) if to_read else (os.O_RDWR, fcntl.LOCK_EX)
    try:
        file = os.open(path / "lock", access | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise RunDirectoryError(f"replay {path}: {error.strerror}") from None
    try:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except OSError:
            raise RunDirectoryError(
                f"replay {path}: a learner writes to it; stop it first, or, to learn from it "
                "meanwhile, a2s learner --replay-from NAME --connect ENDPOINT"
                if to_read
                else f"replay {path}: another learner writes to it, or learns from it; "
                "stop that first"
            ) from None
        yield file
    except BaseException:
        os.close(file)
        raise
