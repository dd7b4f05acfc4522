"""Arrays in files: their room is taken when they are made, so that a full disk is noticed then."""

import mmap
import os
from pathlib import Path

import numpy as np

from a2s.protocol.errors import RunDirectoryError
from a2s.protocol.fields import Array

_ITEM_BYTES = 4


class MappedArray:
    """A float32 array that lies in a file; what is written to it survives this process.

    Args:
        path: The file.
        shape: Of the array.
        new: Make the file, all zeros, with all its room.
        writable: Whether it may be written to.

    Attributes:
        array: float32 of that shape.

    Raises:
        RunDirectoryError: There is no room, or the file is missing or of another size.
    """

    def __init__(
        self, path: Path, shape: tuple[int, ...], *, new: bool = False, writable: bool = True
    ) -> None:
        expected = int(np.prod(shape)) * _ITEM_BYTES
        flags = (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC
        try:
            file = os.open(path, flags | (os.O_CREAT | os.O_EXCL if new else 0), 0o644)
            try:
                if new:
                    os.posix_fallocate(file, 0, expected)
                found = os.fstat(file).st_size
                if found != expected:
                    raise RunDirectoryError(
                        f"{path}: found {found} bytes, expected {expected}; the file is damaged, "
                        "move the directory away to begin another"
                    )
                access = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
                self._map = mmap.mmap(file, expected, flags=mmap.MAP_SHARED, prot=access)
            finally:
                os.close(file)
        except OSError as error:
            if new:
                path.unlink(missing_ok=True)
            raise RunDirectoryError(
                f"{path}: {error.strerror}, {expected / 2**20:.0f} MiB are needed"
            ) from None
        self.array: Array = np.frombuffer(self._map, np.float32).reshape(shape)

    def flush(self) -> None:
        """Write everything to the disk, for the case that the machine dies."""
        self._map.flush()
