"""Batches a second of a served replay, beside dm-reverb: served.py --reverb-python PYTHON.

PYTHON is that of an environment with ``pip install dm-reverb[tensorflow]``. Both take turns. The
server, full of transitions, and its one client are in one process; a batch is 256 transitions.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import numpy as np

from a2s.commands.bench_data import SPACES, STEPS, make_segment
from a2s.commands.bench_replay import served
from a2s.learner.replay import directory

ROWS = 20_000


def main() -> None:
    """Print medians over the rounds, and of the ratio within a round."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reverb-python", required=True)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=1.0, help="of one turn")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        replay = directory.create(folder / "replay", "E", SPACES, ROWS)
        stack.callback(replay.close)
        rng = np.random.default_rng(0)
        for seq in range(ROWS // STEPS):
            replay.insert(make_segment(rng, seq=seq))
        ours = served(replay, stack)
        peer = _peer(arguments.reverb_python, stack)
        rates = []
        for _ in range(arguments.rounds):
            theirs = _theirs(peer, arguments.seconds)
            count, begin_s = 0, time.perf_counter()
            while time.perf_counter() - begin_s < arguments.seconds:
                ours.call()
                count += 1
            rates.append((count / (time.perf_counter() - begin_s), theirs))
    mine, other = (statistics.median(each) for each in zip(*rates, strict=True))
    ratio = statistics.median(a / b for a, b in rates)
    sys.stdout.write(f"a2s {mine:.0f}/s, dm-reverb {other:.0f}/s, ratio {ratio:.2f}\n")


def _peer(python: str, stack: ExitStack) -> "subprocess.Popen[str]":
    script = str(Path(__file__).with_name("reverb_peer.py"))
    process = subprocess.Popen(
        [python, script],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": ""},
    )
    stack.callback(process.wait)
    stack.callback(_pipe(process.stdin).close)
    if _pipe(process.stdout).readline() != "ready\n":
        sys.exit(f"{script}: ended early; run it by itself to see why")
    return process


def _theirs(peer: "subprocess.Popen[str]", seconds: float) -> float:
    told = _pipe(peer.stdin)
    told.write(f"{seconds}\n")
    told.flush()
    return float(_pipe(peer.stdout).readline())


def _pipe(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe


if __name__ == "__main__":
    main()
