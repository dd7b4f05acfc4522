"""``a2s replay``: looking into a replay, in a directory or served by a running learner."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from a2s.learner.replay import directory
from a2s.learner.replay.files import Description
from a2s.learner.replay.remote import RemoteReplay
from a2s.learner.replay.sampling import Transitions
from a2s.learner.run.config import read
from a2s.learner.run.directory import CONFIG
from a2s.protocol.access import LEARNER, VIEWER
from a2s.protocol.errors import UsageError
from a2s.protocol.generations import start_of
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.replay_messages import COLUMNS, ReplayInfo
from a2s.protocol.zenoh_bus import ZenohBus


def info(path: Path | None, connect: str | None, security: Security, run: str) -> dict[str, Any]:
    """Describe a replay: of a run or replay directory, or of a run served at an endpoint.

    Returns:
        For example ``{"env": "Hopper-v5", "transitions": 81920, ...}``.

    Raises:
        UsageError: Both, or neither, of path and endpoint are given.
        A2SError: It cannot be read or reached.
    """
    if (stored := _directory(path, connect)) is not None:
        replay = directory.look_at(stored)
        live = replay.live
        found = _describe(replay.about, live.start, live.stop)
        source = {"source": replay.about.source} if replay.about.source else {}
        return {**found, "torn_records": replay.torn_records, **source}
    with _served(connect, security, run) as served:
        told = served.info()
    found = _describe(told, told.begin, told.end)
    return {**found, "run": told.run, "generation": start_of(told.generation)}


def sample(
    path: Path | None,
    connect: str | None,
    security: Security,
    run: str,
    batch_size: int,
    seed: int,
    **how: Any,
) -> Transitions:
    """Draw a batch from the replay that `info` describes; ``how`` is as `Replay.sample` takes it.

    Raises:
        UsageError: Both, or neither, of path and endpoint are given.
        A2SError: It cannot be read or reached, or it is empty.
    """
    rng = np.random.default_rng(seed)
    if (stored := _directory(path, connect)) is not None:
        return directory.look_at(stored, alpha=_exponent(stored)).sample(batch_size, rng, **how)
    with _served(connect, security, run) as served:
        return served.sample(batch_size, rng, **how)


def write(arrays: dict[str, Any], output: Path) -> None:
    """Write the columns of a batch as an ``.npz`` file.

    Raises:
        UsageError: The file cannot be written.
    """
    try:
        with output.open("wb") as file:
            np.savez(file, **arrays)
    except OSError as error:
        raise UsageError(f"{output}: {error.strerror}") from None


def as_arrays(batch: Transitions) -> dict[str, Any]:
    """Name the columns of a batch."""
    return {name: getattr(batch, name) for name in COLUMNS}


def _directory(path: Path | None, connect: str | None) -> Path | None:
    """Find the directory of a stored replay; ``None`` for a served one."""
    if path is not None and connect is not None:
        raise UsageError(
            f"replay: found both {path} and {connect}, from --connect or A2S_CONNECT; "
            "leave out the one, or unset the other"
        )
    if path is None and connect is None:
        raise UsageError("replay: name a run directory, or a learner with --connect ENDPOINT")
    return None if path is None else directory.find(path)


@contextmanager
def _served(connect: str | None, security: Security, run: str) -> Iterator[RemoteReplay]:
    assert connect is not None
    endpoint, identity = security.endpoint(connect), security.peer(VIEWER, LEARNER)
    with closing(ZenohBus.connect(endpoint, lambda: False, identity)) as bus:
        yield RemoteReplay(bus, Keys(run))


def _exponent(stored: Path) -> float:
    """Find the exponent that the run of a replay directory gives its priorities."""
    config = stored.parent / CONFIG
    hyper = read(config)[1] if config.exists() else {}
    return float(hyper.get("priority_exponent", 0.6))


def _describe(about: Description | ReplayInfo, begin: int, end: int) -> dict[str, Any]:
    return {
        "env": about.env_id,
        "obs_size": about.spaces.obs_size,
        "action_size": about.spaces.action_size,
        "capacity": about.capacity,
        "transitions": end - begin,
        "begin": begin,
        "end": end,
    }
