"""Compares the processor time of updates of two checkouts, in alternating turns of two processes.

``.venv/bin/python benchmarks/turns.py OLD NEW [PAIRS]``; the ratio is old to new, above 1 where the
new one is faster. Both must have the modules that `_work` imports.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

OBS, ACTION = 17, 6


def _on_policy() -> Callable[[], object]:
    from a2s.learner.on_policy.batch import Batch
    from a2s.learner.on_policy.config import OnPolicyConfig
    from a2s.learner.on_policy.update import OnPolicy

    algorithm, steps, segments = OnPolicy(OBS, ACTION, OnPolicyConfig(recovery="off"), 0), 2048, 16
    obs, bounds = torch.randn(steps, OBS), (-torch.ones(ACTION), torch.ones(ACTION))
    choice = algorithm.suggester(*bounds)(obs, torch.randn(steps, 1, ACTION))
    batch = Batch(
        obs=obs,
        suggestion=choice.suggestion,
        log_prob=choice.log_prob,
        reward=torch.randn(steps),
        lengths=torch.full((segments,), steps // segments),
        weights_version=torch.zeros(segments, dtype=torch.int64),
        final_obs=torch.randn(segments, OBS),
        terminated=torch.zeros(segments, dtype=torch.bool),
        truncated=torch.zeros(segments, dtype=torch.bool),
        episode_returns=torch.zeros(0),
    )
    return lambda: algorithm.update(batch, 0.1)


def _off_policy() -> Callable[[], object]:
    from a2s.learner.off_policy.transitions import Transitions
    from a2s.learner.off_policy.update import OffPolicy
    from a2s.learner.run.config import off_policy

    algorithm, rows = OffPolicy(OBS, ACTION, off_policy("modern", {}), 0), 256
    obs, action, next_obs = torch.randn(rows, OBS), torch.rand(rows, ACTION), torch.randn(rows, OBS)
    ones = torch.ones(rows)
    batch = Transitions(obs, action, torch.randn(rows), next_obs, 0.99 * ones, ones)
    algorithm.observe(obs)
    return lambda: [algorithm.update(batch) for _ in range(20)]


def _work(kind: str) -> None:
    """Make an update whenever a line comes in, and print its processor time in seconds."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    update = _on_policy() if kind == "on-policy" else _off_policy()
    update()
    update()
    for _ in sys.stdin:
        begin_s = time.process_time()
        update()
        sys.stdout.write(f"{time.process_time() - begin_s}\n")
        sys.stdout.flush()


def _start(tree: Path, kind: str) -> subprocess.Popen[str]:
    pipe, env = subprocess.PIPE, {**os.environ, "PYTHONPATH": str(tree / "src")}
    command = [sys.executable, __file__, "--work", kind]
    return subprocess.Popen(command, env=env, stdin=pipe, stdout=pipe, text=True)


def _turn(process: subprocess.Popen[str]) -> float:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def main() -> None:
    """Print the median and the quartiles of the ratios, by variant."""
    if sys.argv[1] == "--work":
        _work(sys.argv[2])
        return
    pairs = int(sys.argv[3]) if len(sys.argv) > 3 else 41
    for kind in ("on-policy", "off-policy"):
        old, new = (_start(Path(tree).resolve(), kind) for tree in sys.argv[1:3])
        ratios = []
        for number in range(pairs):
            times = {process: _turn(process) for process in ((old, new), (new, old))[number % 2]}
            ratios.append(times[old] / times[new])
        for process in (old, new):
            process.kill()
            process.wait()
        low, median, high = statistics.quantiles(ratios, n=4)
        spread = f"quartiles {low:.3f} to {high:.3f}, {pairs} pairs"
        sys.stdout.write(f"{kind}: old/new {median:.3f}, {spread}\n")


if __name__ == "__main__":
    main()
