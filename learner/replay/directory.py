"""Making a replay in a directory, and opening the one that is there."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from a2s.learner.replay import description
from a2s.learner.replay.description import Description
from a2s.learner.replay.index import Index
from a2s.learner.replay.priorities import Priorities
from a2s.learner.replay.record import Record
from a2s.learner.replay.replay import Replay
from a2s.learner.replay.resize import copy_newest
from a2s.learner.replay.ring import Ring
from a2s.learner.replay.store import Store, lock
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.fields import Spaces


def find(path: Path) -> Path:
    """Find the replay of a run directory, or take the path itself for one."""
    inside = path / "replay"
    return inside if (inside / description.NAME).exists() else path


def create(
    path: Path,
    env_id: str,
    spaces: Spaces,
    capacity: int,
    *,
    batch_size: int = 1,
    alpha: float = 0.6,
) -> Replay:
    """Make a replay; all the room that it will need on the disk is taken now.

    Args:
        path: A directory that holds no replay yet.
        env_id: Environment.
        spaces: Its spaces.
        capacity: Transitions that it holds; the oldest are evicted.
        batch_size: The largest batch that will be sampled.
        alpha: Exponent of the priorities.

    Raises:
        UsageError: The capacity is below one batch.
        RunDirectoryError: There is a replay already, no room, or no permission.
    """
    _require_capacity(capacity, batch_size)
    about = Description(env_id=env_id, spaces=spaces, capacity=capacity, files=1)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"replay {path}: {error.strerror}") from None
    lock_file = lock(path)
    try:
        if (path / description.NAME).exists():
            raise RunDirectoryError(f"replay {path}: is there already; resume, or name another run")
        for index_file in path.glob("index-*.log"):
            if index_file.stat().st_size:  # one that a kill left while it was made is empty
                raise RunDirectoryError(
                    f"replay {path}: found transitions in {index_file.name}, but no "
                    f"{description.NAME}; move the directory away to begin another"
                )
        store = Store.make(path, about)
        index = store.index(0)
        about.write(path)
    except BaseException:
        os.close(lock_file)
        raise
    ring = Ring(capacity, store.slots)
    priorities = Priorities(store.priority, alpha)
    return Replay(about, ring, priorities, index=index, store=store, lock_file=lock_file)


def open_existing(
    path: Path,
    *,
    env_id: str | None = None,
    spaces: Spaces | None = None,
    capacity: int | None = None,
    batch_size: int = 1,
    is_known: Callable[[str, int], bool] | None = None,
    least_rows: int = 0,
    alpha: float = 0.6,
) -> Replay:
    """Open a replay to go on with it; every live row is compared with its checksum.

    Args:
        path: The directory.
        env_id: Environment that it must be of.
        spaces: Spaces that it must have.
        capacity: Another capacity to give it, the newest rows are kept.
        batch_size: The largest batch that will be sampled.
        is_known: Whether the segment with this actor and number was written into the ledger.
            Those at the end that were not were not acknowledged either, and are taken back.
        least_rows: Rows that were inserted before the newest checkpoint. They are on the disk,
            whatever is killed, so that what lacks them is damaged and not torn.
        alpha: Exponent of the priorities.

    Raises:
        UsageError: The capacity is below one batch.
        RunDirectoryError: There is none, it is damaged, of another environment or in use, or
            there is no room for another capacity; nothing was destroyed.
    """
    about = description.read(path)
    if env_id is not None and spaces is not None:
        about.require(path, env_id, spaces)
    capacity = about.capacity if capacity is None else capacity
    _require_capacity(capacity, batch_size)
    lock_file = lock(path)
    try:
        store = Store(path, about, writable=True)
        ring, records, live = store.restore(is_known)
        if records.next_row < least_rows:
            raise RunDirectoryError(
                f"replay {path}: found {records.next_row} transitions that are whole and in the "
                f"ledger, expected at least the {least_rows} of the newest checkpoint; restore the "
                "files, or move the directory away to begin another"
            )
        if capacity == about.capacity:
            index = store.index(records.num_bytes)
        else:
            about = replace(about, capacity=capacity, files=about.files + 1)
            store, ring, index = _resized(path, about, store, ring, live)
    except BaseException:
        os.close(lock_file)
        raise
    priorities = Priorities(store.priority, alpha)
    priorities.restore(ring.begin, ring.end)
    return Replay(
        about,
        ring,
        priorities,
        index=index,
        store=store,
        lock_file=lock_file,
        torn_records=records.torn,
        taken_back=records.taken_back,
    )


def look_at(path: Path, *, alpha: float = 0.6, alone: bool = False) -> Replay:
    """Open a replay to read it, also while a learner writes to it: it is seen as it is now.

    Nothing in the directory is changed. What the learner inserts later is not seen, but comes to
    lie over the oldest rows: whoever reads for long must be alone.

    Args:
        path: The directory.
        alpha: Exponent of the priorities.
        alone: Refuse one that a learner writes to, and keep learners out until it is closed.

    Raises:
        RunDirectoryError: There is none, it is damaged, or a learner writes to it.
    """
    about = description.read(path)
    lock_file = lock(path, to_read=True) if alone else -1
    try:
        store = Store(path, about, writable=False)
        ring, records, _ = store.restore()
    except BaseException:
        if alone:
            os.close(lock_file)
        raise
    priorities = Priorities(store.priority.copy(), alpha)
    priorities.restore(ring.begin, ring.end)
    return Replay(
        about,
        ring,
        priorities,
        is_writable=False,
        lock_file=lock_file,
        torn_records=records.torn,
    )


def _resized(
    path: Path, about: Description, store: Store, ring: Ring, live: list[Record]
) -> tuple[Store, Ring, Index]:
    target = Store.make(path, about)
    copied = Ring(about.capacity, target.slots)
    index = target.index(0)
    packed = copy_newest(ring, live, copied)
    index.append(packed, copied.begin)
    row = np.arange(copied.begin, copied.end)
    target.priority[row % len(target.priority)] = store.priority[row % len(store.priority)]
    target.flush()
    index.flush()
    about.write(path)  # from here on the new files count
    store.delete()
    return target, copied, index


def _require_capacity(capacity: int, batch_size: int) -> None:
    if capacity < batch_size:
        raise UsageError(
            f"replay capacity: found {capacity}, expected at least one batch of {batch_size}"
        )
