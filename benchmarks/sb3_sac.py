"""Stable-Baselines3's SAC with its own defaults, as an outside reference.

It needs ``pip install stable-baselines3==2.9.2``. It leaves episodes.csv and summary.json behind,
in the columns and with the keys that `run.py` reads.
"""

import argparse
import csv
import json
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor


def main() -> None:
    """Train and evaluate one seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", required=True)
    parser.add_argument("--total-steps", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--run-dir", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    begin_s = time.monotonic()
    played = Monitor(gymnasium.make(options.env))
    model = SAC("MlpPolicy", played, seed=options.seed, device="cpu")
    model.learn(options.total_steps)
    wall_s = time.monotonic() - begin_s
    fresh = Monitor(gymnasium.make(options.env))
    fresh.reset(seed=1000)
    returns, _ = evaluate_policy(model, fresh, 10, return_episode_rewards=True)
    _write_episodes(options.run_dir / "episodes.csv", played)
    summary = {
        "env_steps": options.total_steps,
        "mean": round(float(np.mean(returns)), 1),
        "mean_std": round(float(np.std(returns)), 1),
        "return_best": round(max(played.get_episode_rewards()), 1),
        "wall_s": round(wall_s),
    }
    (options.run_dir / "summary.json").write_text(json.dumps(summary))


def _write_episodes(path: Path, played: "Monitor[object, object]") -> None:
    steps = np.cumsum(played.get_episode_lengths()).tolist()
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["wall_s", "env_steps", "return"])
        rows = zip(played.get_episode_times(), steps, played.get_episode_rewards(), strict=True)
        writer.writerows(rows)


if __name__ == "__main__":
    main()
