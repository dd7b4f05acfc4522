"""Checkpoints: one directory each, written whole or not at all, with nothing that can run code.

``checkpoints/00000120/`` holds ``tensors.safetensors`` and ``state.json``; the checksum of the
first is in the second, so a damaged checkpoint is recognised and never half used.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from a2s.protocol.errors import RunDirectoryError

_MAX_KEPT = 3
_FORMAT = 5


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
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        data = safetensors.torch.save({k: v.contiguous() for k, v in tensors.items()})
        sha256 = hashlib.sha256(data).hexdigest()
        checked = {"format": _FORMAT, "kind": kind, "sha256": sha256, "state": state}
        text = json.dumps(checked).encode()
        _write(partial / "tensors.safetensors", data)
        _write(partial / "state.json", text)
        partial.rename(path)
    except OSError as error:
        raise RunDirectoryError(f"checkpoint {path}: {error.strerror}") from error
    for old in _all(folder)[:-_MAX_KEPT]:
        shutil.rmtree(old, ignore_errors=True)
    return path, len(data) + len(text)


def load(folder: Path, *, kind: str | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the newest checkpoint of a run of this kind, or of any.

    Returns:
        Tensors and state, as they were given to :func:`save`.

    Raises:
        RunDirectoryError: The folder has no checkpoint, or the newest is of another kind or
            damaged; it is never skipped silently for an older one.
    """
    found = _all(folder)
    if not found:
        raise RunDirectoryError(
            f"{folder}: found no checkpoint to go on from; name another --run-dir, or delete "
            f"{folder.parent}"
        )
    path = found[-1]
    advice = f"delete {path} to go on from the one before"
    try:
        checked = json.loads((path / "state.json").read_text())
        if checked["format"] != _FORMAT:
            raise RunDirectoryError(
                f"checkpoint {path}: found format {checked['format']}, expected {_FORMAT}; another "
                "version of a2s made it: go on with that one, or begin another run"
            )
        if kind not in (None, checked["kind"]):
            raise RunDirectoryError(
                f"checkpoint {path}: found {checked['kind']}, expected {kind}; "
                "--resume goes on with the same run only"
            )
        data = (path / "tensors.safetensors").read_bytes()
        if hashlib.sha256(data).hexdigest() != checked["sha256"]:
            raise RunDirectoryError(f"checkpoint {path}: the checksum does not match; {advice}")
        return safetensors.torch.load(data), checked["state"]
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise RunDirectoryError(f"checkpoint {path}: damaged ({error}); {advice}") from error


def _free(folder: Path, name: str) -> Path:
    """Find a name that sorts last; existing files are never replaced, so a kill cannot lose any."""
    same = [path for path in _all(folder) if path.name.startswith(name)]
    if not same:
        return folder / name
    count = int(same[-1].name.partition("-")[2] or 0) + 1
    return folder / f"{name}-{count:04d}"


def _all(folder: Path) -> list[Path]:
    return sorted(folder.glob("[0-9]*")) if folder.exists() else []


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
