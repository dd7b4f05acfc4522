"""Updates per second of off-policy learning beside Stable-Baselines3's SAC, and sbx's (JAX).

    python benchmarks/off_policy/speed.py [--sbx-python OTHER_ENVIRONMENT/bin/python]

All learn from made-up rows: 17 observed numbers, 6 actions, batches of 256, hidden layers
256-256. Each contender is a process of its own with one thread of torch (JAX takes what it
wants); they take turns, so that a machine that is busy slows all alike. Prints a JSON list of
``{name, value, unit, baseline, ratio}``: medians over the turns; ``ratio`` is the median of the
ratios to Stable-Baselines3 within a turn. It needs ``pip install stable-baselines3==2.9.2``.
"""

import argparse
import importlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

OBS, ACTION, ROWS, STORED = 17, 6, 256, 20_000
BASELINE = "sb3"
Steps = Callable[[int], None]

OURS: dict[str, tuple[str, dict[str, object]]] = {
    "a2s sac f32": ("sac", {"precision": "f32"}),
    "a2s sac bf16": ("sac", {"precision": "bf16"}),
    "a2s sac bf16 K_target=4": ("sac", {"precision": "bf16", "target_suggestions": 4}),
    "a2s sac bf16 no LayerNorm": ("sac", {"precision": "bf16", "layer_norm": False}),
    "a2s modern bf16": ("modern", {"precision": "bf16"}),
}
THEIRS = {BASELINE: "stable_baselines3", "sbx": "sbx"}


def ours(preset: str, options: dict[str, object]) -> Steps:
    """Updates from rows drawn from an array, as a replay would."""
    import torch

    from a2s.learner.algorithm.off_policy import OffPolicy
    from a2s.learner.algorithm.transitions import Transitions
    from a2s.learner.memory import keep_freed_memory
    from a2s.learner.off_policy_presets import off_policy

    keep_freed_memory()
    torch.set_num_threads(1)
    algorithm = OffPolicy(OBS, ACTION, off_policy(preset, options), 0)
    stored = Transitions(
        obs=torch.randn(STORED, OBS),
        action=2.0 * torch.rand(STORED, ACTION) - 1.0,
        reward=torch.randn(STORED),
        next_obs=torch.randn(STORED, OBS),
        discount=torch.full((STORED,), 0.99),
        weight=torch.ones(STORED),
    )
    algorithm.observe(stored.obs)

    def steps(count: int) -> None:
        for _ in range(count):
            rows = torch.randint(STORED, (ROWS,))
            algorithm.update(Transitions(*(each[rows] for each in stored)))

    return steps


def theirs(module: str) -> Steps:
    """Their ``train`` alone, with their defaults."""
    import gymnasium as gym

    class Shape(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (ACTION,), np.float32)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return np.zeros(OBS, np.float32), {}

    if module == "stable_baselines3":
        import torch

        torch.set_num_threads(1)
    library = importlib.import_module(module)
    model = library.SAC("MlpPolicy", Shape(), buffer_size=STORED, learning_starts=0)
    model._setup_learn(1, None)
    rng = np.random.default_rng(0)
    for _ in range(STORED):
        obs, new = rng.standard_normal((2, 1, OBS)).astype(np.float32)
        action = rng.uniform(-1, 1, (1, ACTION)).astype(np.float32)
        model.replay_buffer.add(obs, new, action, rng.standard_normal(1), np.zeros(1), [{}])

    def steps(count: int) -> None:
        model.train(gradient_steps=count, batch_size=ROWS)

    return steps


def contend(name: str) -> None:
    """Be one contender: a line with a number of updates in, a line with seconds out."""
    steps = ours(*OURS[name]) if name in OURS else theirs(THEIRS[name])
    for line in sys.stdin:
        start_s = time.perf_counter()
        steps(int(line))
        sys.stdout.write(f"{time.perf_counter() - start_s}\n")
        sys.stdout.flush()


class Contender:
    """A process that updates when told."""

    def __init__(self, name: str, python: str) -> None:
        self.process = subprocess.Popen(
            [python, __file__, "--contend", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def rate(self, updates: int) -> float:
        """Updates per second over so many."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{updates}\n")
        self.process.stdin.flush()
        return updates / float(self.process.stdout.readline())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--block", type=int, default=50, help="updates in one turn")
    parser.add_argument("--sbx-python", default="", help="interpreter that has sbx-rl")
    parser.add_argument("--contend", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.contend:
        contend(options.contend)
        return
    pythons = dict.fromkeys([*OURS, BASELINE], sys.executable)
    pythons |= {"sbx": options.sbx_python} if options.sbx_python else {}
    contenders = {name: Contender(name, python) for name, python in pythons.items()}
    found: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(options.turns + 1):
        for name, contender in contenders.items():
            rate = contender.rate(options.block)
            found[name] += [rate] if turn else []  # the first turn warms up
    rows = []
    for name, rates in found.items():
        ratios = [mine / base for mine, base in zip(rates, found[BASELINE], strict=True)]
        rows.append(
            {
                "name": name,
                "value": round(statistics.median(rates), 1),
                "unit": "updates/s",
                "baseline": round(statistics.median(found[BASELINE]), 1),
                "ratio": round(statistics.median(ratios), 2),
            }
        )
    json.dump(rows, sys.stdout, indent=1)
    sys.stdout.write("\n")
    for contender in contenders.values():
        contender.process.communicate()


if __name__ == "__main__":
    main()
