"""The replay beside torchrl's and cpprb's: transitions a second, interleaved in one process.

    pip install torchrl cpprb
    OMP_NUM_THREADS=1 python benchmarks/replay/run.py

Every round times every contender once, so that whatever else the machine does hits all of them;
a ratio is the median over the rounds of ours to the fastest of the others in the same round.
Transitions are those of HalfCheetah (17 observations, 6 actions); a segment has 1000 steps.
"""

import argparse
import importlib
import json
import logging
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from a2s.learner.replay import directory
from a2s.learner.replay.replay import Replay
from a2s.protocol.messages import Array, Segment, Spaces

OBS, ACTION, STEPS, BATCH = 17, 6, 1000, 256
SPACES = Spaces(
    obs_size=OBS,
    action_low=-np.ones(ACTION, np.float32),
    action_high=np.ones(ACTION, np.float32),
)
Contenders = dict[str, Callable[[], object]]

rng = np.random.default_rng(0)


def normal(*shape: int) -> Array:
    """Draw float32 numbers."""
    return rng.standard_normal(shape, dtype=np.float32)


def make_segment(seq: int) -> Segment:
    """Make a whole episode."""
    return Segment(
        actor="a",
        seq=seq,
        generation=1,
        epoch=0,
        weights_version=0,
        env=0,
        obs=normal(STEPS, OBS),
        suggestion=normal(STEPS, ACTION),
        log_prob=normal(STEPS),
        reward=normal(STEPS),
        final_obs=normal(OBS),
        terminated=False,
        truncated=True,
        episode_return=0.0,
        episode_length=STEPS,
    )


def columns(segment: Segment) -> dict[str, Array]:
    """Lay the same transitions out as the others want them, outside of what is timed."""
    return {
        "obs": segment.obs,
        "action": segment.suggestion,
        "reward": segment.reward[:, None],
        "next_obs": np.concatenate([segment.obs[1:], segment.final_obs[None]]),
        "done": np.zeros((STEPS, 1), np.float32),
    }


def in_turn(call: Callable[[Any], object], items: list[Any]) -> Callable[[], object]:
    """Call with one item after the other."""
    state = {"next": 0}

    def step() -> None:
        call(items[state["next"]])
        state["next"] = (state["next"] + 1) % len(items)

    return step


def ours(segments: list[Segment], replay: Replay) -> Contenders:
    """Make our contenders."""
    draw = np.random.default_rng(1)

    def update() -> None:
        batch = replay.sample(BATCH, draw, prioritised=True)
        replay.update_priorities(batch.row, np.abs(batch.reward))

    return {
        "insert": in_turn(replay.insert, segments),
        "uniform": lambda: replay.sample(BATCH, draw),
        "3-step": lambda: replay.sample(BATCH, draw, n_step=3),
        "prioritised": update,
    }


def cpprb_s(segments: list[Segment], capacity: int) -> Contenders:
    """Make cpprb's."""
    cpprb: Any = importlib.import_module("cpprb")
    fields = {"obs": {"shape": OBS}, "action": {"shape": ACTION}, "reward": {}, "done": {}}
    fields["next_obs"] = {"shape": OBS}
    uniform = cpprb.ReplayBuffer(capacity, fields)
    prioritised = cpprb.PrioritizedReplayBuffer(capacity, fields, alpha=0.6)

    def update() -> None:
        batch = prioritised.sample(BATCH, beta=0.4)
        prioritised.update_priorities(batch["indexes"], np.abs(batch["reward"][:, 0]))

    made = [columns(s) for s in segments]
    for _ in range(capacity // STEPS + 1):
        prioritised.add(**made[0])
    return {
        "insert": in_turn(lambda c: uniform.add(**c), made),
        "uniform": lambda: uniform.sample(BATCH),
        "prioritised": update,
    }


def torchrl_s(segments: list[Segment], capacity: int) -> Contenders:
    """Make torchrl's."""
    data: Any = importlib.import_module("torchrl.data")
    tensordict: Any = importlib.import_module("tensordict")
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it writes to standard output
    made = [
        tensordict.TensorDict(
            {k: torch.from_numpy(v) for k, v in columns(s).items()}, batch_size=STEPS
        )
        for s in segments
    ]
    uniform = data.TensorDictReplayBuffer(
        storage=data.LazyTensorStorage(capacity), batch_size=BATCH
    )
    prioritised = data.TensorDictPrioritizedReplayBuffer(
        alpha=0.6, beta=0.4, storage=data.LazyTensorStorage(capacity), batch_size=BATCH
    )

    def update() -> None:
        batch = prioritised.sample()
        batch["td_error"] = batch["reward"][:, 0].abs()
        prioritised.update_tensordict_priority(batch)

    for _ in range(capacity // STEPS + 1):
        prioritised.extend(made[0])
    return {
        "insert": in_turn(uniform.extend, made),
        "uniform": uniform.sample,
        "prioritised": update,
    }


def measure(call: Callable[[], object], seconds: float) -> float:
    """Count calls a second."""
    count, begin = 0, time.perf_counter()
    while (spent := time.perf_counter() - begin) < seconds:
        call()
        count += 1
    return count / spent


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--seconds", type=float, default=0.1, help="of one measurement")
    parser.add_argument("--capacity", type=int, default=1 << 18)
    options = parser.parse_args()
    torch.set_num_threads(1)
    segments = [make_segment(i) for i in range(20)]
    with tempfile.TemporaryDirectory() as folder:
        stored = directory.create(Path(folder) / "replay", "E", SPACES, options.capacity)
        replay = Replay.in_memory("E", SPACES, options.capacity)
        all_contenders = {
            "a2s": ours(segments, replay),
            "a2s in files": ours(segments, stored),
            "cpprb": cpprb_s(segments, options.capacity),
            "torchrl": torchrl_s(segments, options.capacity),
        }
        for contenders in all_contenders.values():
            for _ in range(options.capacity // STEPS + 1):
                contenders["insert"]()
        found: dict[tuple[str, str], list[float]] = {}
        for round_ in range(options.rounds + 1):
            for what in ("uniform", "prioritised", "3-step", "insert"):
                for who, contenders in all_contenders.items():
                    if what in contenders:
                        rate = measure(contenders[what], options.seconds)
                        if round_:  # the first warms up
                            found.setdefault((what, who), []).append(rate)
        stored.close()
    json.dump(report(found), sys.stdout, indent=1)
    sys.stdout.write("\n")


def report(found: dict[tuple[str, str], list[float]]) -> list[dict[str, object]]:
    """Make medians and ratios of the rates of all rounds."""
    rows: list[dict[str, object]] = []
    for (what, who), rates in found.items():
        others = [found.get((what, other), []) for other in ("cpprb", "torchrl")]
        fastest = [max(pair) for pair in zip(*others, strict=True)] if all(others) else []
        size = STEPS if what == "insert" else BATCH
        ratios = [a / b for a, b in zip(rates, fastest, strict=False)]
        rows.append(
            {
                "name": f"{what}: {who}",
                "value": round(statistics.median(rates) * size),
                "unit": "transitions/s",
                "baseline": round(statistics.median(fastest) * size) if fastest else None,
                "ratio": round(statistics.median(ratios), 2) if ratios else None,
            }
        )
    return rows


if __name__ == "__main__":
    main()
