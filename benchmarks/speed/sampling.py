"""Drawing from a replay in files: ``python -m speed.sampling HOW ROWS SECONDS``: batches/s.

Batches of 256 of a full replay of so many rows of the size of HalfCheetah's, uniform, or by
priority and then with new priorities.
"""

import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from a2s.commands.bench_data import BATCH, ENV_ID, SPACES, STEPS, make_segment
from a2s.learner.replay import directory

CONTENDERS = ("uniform", "prioritised")


def rate(how: str, rows: int, seconds: float) -> float:
    """Fill it, then draw."""
    rng = np.random.default_rng(0)
    segments = [make_segment(rng, seq=seq) for seq in range(20)]
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(directory.create(Path(folder) / "replay", ENV_ID, SPACES, rows)) as replay,
    ):
        for number in range(rows // STEPS + 1):
            replay.insert(segments[number % len(segments)])
        replay.sample(BATCH, rng, prioritised=how == "prioritised")  # makes the tree
        batches, begin_s = 0, time.perf_counter()
        while (spent_s := time.perf_counter() - begin_s) < seconds:
            batch = replay.sample(BATCH, rng, prioritised=how == "prioritised")
            if how == "prioritised":
                replay.update_priorities(batch.row, np.abs(batch.reward))
            batches += 1
    return batches / spent_s


def main() -> None:
    """Measure one."""
    sys.stdout.write(f"{rate(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))}\n")


if __name__ == "__main__":
    main()
