"""Steps a second of whole training loops, beside Stable-Baselines3.

python benchmarks/on_policy/speed.py [ENV ...]; it needs ``pip install stable-baselines3==2.9.2``.
Each contender learns in a process of its own, one after the other, in several rounds: a machine's
speed drifts, so only figures of one round may be compared. The start of processes and the first
half of the steps are not counted.
"""

import argparse
import csv
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STEPS = 60_000
ENVS = ("Hopper-v5", "HalfCheetah-v5")
CONTENDERS = ("a2s", "a2s-8-envs", "a2c", "sb3-ppo", "sb3-a2c")
A2S_OPTIONS = {
    "a2s": ("--n", "2", "--envs", "8"),
    "a2s-8-envs": ("--n", "2", "--envs", "4"),
    "a2c": ("--n", "2", "--envs", "8", "--algo", "a2c"),
}


def ours(options: tuple[str, ...], env: str) -> float:
    """Train, and read the pace of the second half from updates.csv."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        command = (
            sys.executable, "-m", "a2s.cli", "train", "--env", env, "--total-steps", str(STEPS),
            "--run-dir", str(path), "--metrics-port", "-1", "--episodes", "1", *options,
        )  # fmt: skip
        subprocess.run(command, check=True, capture_output=True)
        with (path / "updates.csv").open(newline="") as file:
            rows = [(int(r["env_steps"]), float(r["wall_s"])) for r in csv.DictReader(file)]
    half = [row for row in rows if row[0] >= STEPS / 2]
    return (half[-1][0] - half[0][0]) / (half[-1][1] - half[0][1])


def theirs(algorithm: str, env: str) -> float:
    """Train Stable-Baselines3's algorithm with its defaults, 8 environments and one thread."""
    command = (sys.executable, __file__, "--theirs", algorithm, env)
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return float(done.stdout.split()[-1])


def _learn_theirs(algorithm: str, env: str) -> None:
    import stable_baselines3  # only the process that measures it needs it
    import torch
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)
    kind = {"sb3-ppo": stable_baselines3.PPO, "sb3-a2c": stable_baselines3.A2C}[algorithm]
    model = kind("MlpPolicy", make_vec_env(env, n_envs=8, seed=0), seed=0, device="cpu")
    model.learn(STEPS // 2)
    begin_s, begin = time.perf_counter(), model.num_timesteps
    model.learn(STEPS // 2, reset_num_timesteps=False)
    pace = (model.num_timesteps - begin) / (time.perf_counter() - begin_s)
    sys.stdout.write(f"{pace}\n")


def main() -> None:
    """Print every round and the medians, with ratios to Stable-Baselines3 of the same round."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("envs", nargs="*", default=ENVS)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--theirs", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.theirs:
        _learn_theirs(*arguments.theirs)
        return
    for env in arguments.envs:
        paces: dict[str, list[float]] = {name: [] for name in CONTENDERS}
        for _ in range(arguments.rounds):
            for name in CONTENDERS:
                options = A2S_OPTIONS.get(name)
                paces[name].append(ours(options, env) if options else theirs(name, env))
            latest = " ".join(f"{name}={paces[name][-1]:,.0f}" for name in CONTENDERS)
            sys.stdout.write(f"{env} {latest}\n")
            sys.stdout.flush()
        for name, found in paces.items():
            ratios = [
                statistics.median(a / b for a, b in zip(found, paces[other], strict=True))
                for other in ("sb3-ppo", "sb3-a2c")
            ]
            sys.stdout.write(
                f"| {env} | {name} | {statistics.median(found):,.0f} | {min(found):,.0f} to "
                f"{max(found):,.0f} | {ratios[0]:.2f} | {ratios[1]:.2f} |\n"
            )


if __name__ == "__main__":
    main()
