"""The replay beside torchrl's and cpprb's, as it is filled, sampled and served."""

import importlib
import itertools
import logging
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from a2s.commands.bench import Contender, Contest, optional
from a2s.commands.bench_data import BATCH, SPACES, STEPS, make_segment
from a2s.commands.process import free_endpoint
from a2s.learner.replay import directory
from a2s.learner.replay.remote import RemoteReplay, ServedReplay
from a2s.learner.replay.replay import Replay
from a2s.protocol.fields import Array
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Segment
from a2s.protocol.zenoh_bus import ZenohBus

CAPACITY = 1 << 18
FILLING = CAPACITY // STEPS + 1  # segments that fill it
OPENED_ROWS = 1_000_000


class _Buffer(NamedTuple):
    """One implementation: put a segment in, draw a batch, draw by priority and set priorities."""

    name: str
    insert: Callable[[], object]
    uniform: Callable[[], object]
    prioritised: Callable[[], object]
    is_baseline: bool = True


def contests(stack: ExitStack) -> list[Contest]:
    """Make full replays of all kinds."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    segments = [make_segment(rng, seq=seq) for seq in range(20)]
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    stored = directory.create(folder / "replay", "E", SPACES, CAPACITY)
    stack.callback(stored.close)
    buffers = [
        _ours("a2s, memory", Replay.in_memory("E", SPACES, CAPACITY), segments),
        _ours("a2s, files", stored, segments),
    ]
    if (cpprb := optional("cpprb", "cpprb")) is not None:
        buffers.append(_cpprb(cpprb, segments))
    if (torchrl := optional("torchrl.data", "torchrl")) is not None:
        buffers.append(_torchrl(torchrl, segments))
    for buffer in buffers:
        for _ in range(FILLING):
            buffer.insert()

    def contest(title: str, field: str, size: int) -> Contest:
        contenders = [
            Contender(f"{title}: {one.name}", getattr(one, field), size, one.is_baseline)
            for one in buffers
        ]
        return Contest("transitions/s", contenders)

    return [
        contest("insert a segment", "insert", STEPS),
        contest("uniform sample", "uniform", BATCH),
        contest("prioritised sample and update", "prioritised", BATCH),
        Contest("batches/s", [served(stored, stack)]),
        Contest("openings/s", [_opening(folder / "large", segments)]),
    ]


def _ours(name: str, replay: Replay, segments: list[Segment]) -> _Buffer:
    rng, source = np.random.default_rng(1), itertools.cycle(segments)

    def prioritised() -> None:
        batch = replay.sample(BATCH, rng, prioritised=True)
        replay.update_priorities(batch.row, np.abs(batch.reward))

    return _Buffer(
        name,
        lambda: replay.insert(next(source)),
        lambda: replay.sample(BATCH, rng),
        prioritised,
        is_baseline=False,
    )


def _columns(segment: Segment) -> dict[str, Array]:
    """Lay the same transitions out as the others want them, outside of what is timed."""
    return {
        "obs": segment.obs,
        "action": segment.suggestion,
        "reward": segment.reward[:, None],
        "next_obs": np.concatenate([segment.obs[1:], segment.final_obs[None]]),
        "done": np.zeros((STEPS, 1), np.float32),
    }


def _cpprb(cpprb: Any, segments: list[Segment]) -> _Buffer:
    columns = [_columns(segment) for segment in segments]
    shapes = {name: {"shape": column.shape[1:]} for name, column in columns[0].items()}
    uniform = cpprb.ReplayBuffer(CAPACITY, shapes)
    by_priority = cpprb.PrioritizedReplayBuffer(CAPACITY, shapes, alpha=0.6)
    source = itertools.cycle(columns)
    for _ in range(FILLING):
        by_priority.add(**columns[0])

    def prioritised() -> None:
        batch = by_priority.sample(BATCH, beta=0.4)
        by_priority.update_priorities(batch["indexes"], np.abs(batch["reward"][:, 0]))

    return _Buffer(
        "cpprb", lambda: uniform.add(**next(source)), lambda: uniform.sample(BATCH), prioritised
    )


def _torchrl(data: Any, segments: list[Segment]) -> _Buffer:
    tensordict: Any = importlib.import_module("tensordict")
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it writes to standard output
    columns: list[Any] = [
        tensordict.TensorDict(
            {name: torch.from_numpy(column) for name, column in _columns(segment).items()},
            batch_size=STEPS,
        )
        for segment in segments
    ]
    source = itertools.cycle(columns)
    uniform = data.TensorDictReplayBuffer(
        storage=data.LazyTensorStorage(CAPACITY), batch_size=BATCH
    )
    by_priority = data.TensorDictPrioritizedReplayBuffer(
        alpha=0.6, beta=0.4, storage=data.LazyTensorStorage(CAPACITY), batch_size=BATCH
    )
    for _ in range(FILLING):
        by_priority.extend(columns[0])

    def prioritised() -> None:
        batch = by_priority.sample()
        batch["td_error"] = batch["reward"][:, 0].abs()
        by_priority.update_tensordict_priority(batch)

    return _Buffer("torchrl", lambda: uniform.extend(next(source)), uniform.sample, prioritised)


def served(replay: Replay, stack: ExitStack) -> Contender:
    """Sample a replay over Zenoh, all the time of the server given to it."""
    endpoint, keys = free_endpoint(), Keys("bench")
    server = stack.enter_context(closing(ZenohBus.listen(endpoint)))
    ServedReplay(server, keys, replay, 1, share=1.0).open()
    client = stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False)))
    remote, draw = RemoteReplay(client, keys), np.random.default_rng(2)
    return Contender(f"served batches of {BATCH}", lambda: remote.sample(BATCH, draw))


def _opening(path: Path, segments: list[Segment]) -> Contender:
    """Open a replay of a million rows, every checksum verified."""
    full = directory.create(path, "E", SPACES, OPENED_ROWS)
    for segment, _ in zip(itertools.cycle(segments), range(OPENED_ROWS // STEPS), strict=False):
        full.insert(segment)
    full.close()

    def reopen() -> None:
        directory.open_existing(
            path,
            env_id="E",
            spaces=SPACES,
            is_known=lambda actor, seq: True,
            capacity=OPENED_ROWS,
            batch_size=BATCH,
        ).close()

    return Contender(f"open {OPENED_ROWS:,} rows", reopen)
