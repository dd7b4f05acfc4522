"""Checkpoints: one directory each, written whole or not at all, with nothing that can run code.

``checkpoints/00000120/`` holds ``tensors.safetensors``, ``state.json`` and, as `sha256sum` writes
it, ``SHA256SUMS`` of both, so that a damaged checkpoint is recognised and never half used.
"""

import contextlib
import hashlib
import json
import logging
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.numpy
import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from a2s.protocol.errors import RunDirectoryError

State = dict[str, Any]

logger = logging.getLogger(__name__)

_MAX_KEPT = 3
_FORMAT = 9
_NAME = re.compile(r"[0-9]{8,}(-[0-9]{4,})?")
_TENSORS, _STATE, _SUMS = "tensors.safetensors", "state.json", "SHA256SUMS"


def save(
    folder: Path, updates: int, tensors: dict[str, Tensor], state: dict[str, Any], *, kind: str
) -> tuple[Path, int]:
    """Write the checkpoint after ``updates`` updates, and delete all but the newest three.

    The updates name it, with a count if it is not the first. ``state`` is anything that JSON can
    hold; a run of another ``kind`` cannot go on from here.

    Returns:
        The checkpoint and its size in bytes.

    Raises:
        RunDirectoryError: It cannot be written, for example because the disk is full.
    """
    path = _free(folder, f"{updates:08d}")
    partial = folder / f".{path.name}.partial"
    whole = {"format": _FORMAT, "kind": kind, "state": state}
    # safetensors.torch leaves a cycle for each tensor, which nobody soon collects.
    arrays = {name: tensor.contiguous().cpu().numpy() for name, tensor in tensors.items()}
    files = {
        _TENSORS: safetensors.numpy.save(arrays),
        _STATE: json.dumps(whole).encode(),
    }
    files[_SUMS] = _sums(files)
    try:
        for old in folder.glob(".*.partial"):  # what a kill, or a full disk, has left
            shutil.rmtree(old, ignore_errors=True)
        partial.mkdir(parents=True)
        for name, data in files.items():
            _write(partial / name, data)
        partial.rename(path)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise RunDirectoryError(f"checkpoint {path}: {error.strerror}") from error
    for old in all_of(folder)[:-_MAX_KEPT]:
        shutil.rmtree(old, ignore_errors=True)
    return path, sum(len(data) for data in files.values())


def load(folder: Path, *, kind: str | None = None) -> tuple[dict[str, Tensor], State]:
    """Read the newest whole checkpoint of a run of this kind, or of any; say which are damaged.

    Returns:
        Tensors and state, as they were given to :func:`save`.

    Raises:
        RunDirectoryError: The folder has no whole checkpoint, or the newest is of another kind or
            version.
    """
    found = all_of(folder)
    if not found:
        raise RunDirectoryError(
            f"{folder}: found no checkpoint to go on from; restore one from a copy, or begin "
            "another run"
        )
    for path in reversed(found):
        try:
            return read(path, kind)
        except DamagedError as error:
            going_on = "" if path == found[0] else "; going on from the one before"
            logger.warning("checkpoint %s: %s%s", path, error, going_on)
    raise RunDirectoryError(
        f"{folder}: each of {len(found)} checkpoints is damaged; restore one from a copy, "
        "or begin another run"
    )


def states(folder: Path) -> list[State]:
    """Read the states of all checkpoints whose state is as it was written, the oldest first."""
    found = []
    for path in all_of(folder):
        with contextlib.suppress(OSError):  # one that is not there is damaged
            data = (path / _STATE).read_bytes()
            if _sum(_STATE, data) in (path / _SUMS).read_bytes().splitlines(keepends=True):
                found.append(json.loads(data)["state"])
    return found


class DamagedError(Exception):
    """A checkpoint is not as it was written."""


def read(path: Path, kind: str | None = None) -> tuple[dict[str, Tensor], State]:
    """Read one checkpoint.

    Raises:
        DamagedError: It is not as it was written.
        RunDirectoryError: It is of another kind or version.
    """
    try:
        files = {name: (path / name).read_bytes() for name in (_TENSORS, _STATE)}
        has_sums = (path / _SUMS).exists()  # early versions wrote none
        if has_sums and (path / _SUMS).read_bytes() != _sums(files):
            raise DamagedError("the checksums do not match")
        whole = json.loads(files[_STATE])
        if whole["format"] != _FORMAT:
            raise RunDirectoryError(
                f"checkpoint {path}: found format {whole['format']}, expected {_FORMAT}; another "
                "version of a2s made it: go on with that one, or begin another run"
            )
        if not has_sums:
            raise DamagedError(f"{_SUMS} is not there")
        if kind not in (None, whole["kind"]):
            raise RunDirectoryError(
                f"checkpoint {path}: found {whole['kind']}, expected {kind}; "
                "--resume goes on with the same run only"
            )
        return safetensors.torch.load(files[_TENSORS]), whole["state"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        raise DamagedError(str(error)) from None


def _sums(files: Mapping[str, bytes]) -> bytes:
    """One line for each of tensors and state."""
    return b"".join(_sum(name, files[name]) for name in (_TENSORS, _STATE))


def _sum(name: str, data: bytes) -> bytes:
    return f"{hashlib.sha256(data).hexdigest()}  {name}\n".encode()


def _free(folder: Path, name: str) -> Path:
    """Find a name that sorts last; existing files are never replaced, so a kill cannot lose any."""
    same = [count for updates, count in map(_order, all_of(folder)) if updates == int(name)]
    return folder / f"{name}-{same[-1] + 1:04d}" if same else folder / name


def all_of(folder: Path) -> list[Path]:
    """Find the checkpoints in a folder, the newest last."""
    found = (path for path in folder.glob("[0-9]*") if _NAME.fullmatch(path.name))
    return sorted(found, key=_order)


def _order(path: Path) -> tuple[int, int]:
    """The updates and the count in a checkpoint's name: with more digits text sorts otherwise."""
    updates, _, count = path.name.partition("-")
    return int(updates), int(count or 0)


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
