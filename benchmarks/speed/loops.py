"""Whole loops, acting while learning: ``python -m speed.loops CONTENDER ENV SECONDS``: steps/s.

ENV may be followed by options of ``a2s train``, in the same word: ``"Hopper-v5 --n 4"``.

Each learns in processes of its own. The first part of a run, with what has to be loaded, is not
counted: a2s counts the second half of its updates, the others count from their second update on.
"""

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

CONTENDERS = ("a2s", "a2s a2c", "SB3 PPO", "SB3 A2C")
_OURS = {"a2s": (), "a2s a2c": ("--algo", "a2c")}
_STEPS_A_SECOND = 10_000  # the most that is expected: a run ends by its steps
_ENVS = 8


def ours(options: tuple[str, ...], env: str, seconds: float) -> float:
    """Train with the defaults for about so long, and read the pace of the second half."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        command = (
            sys.executable, "-m", "a2s.cli", "train", "--env", env, "--run-dir", str(path),
            "--total-steps", str(int(seconds * _STEPS_A_SECOND)), "--metrics-port", "-1",
            "--episodes", "1", *options,
        )  # fmt: skip
        subprocess.run(command, check=True, capture_output=True)
        with (path / "updates.csv").open(newline="") as file:
            rows = [(int(r["env_steps"]), float(r["wall_s"])) for r in csv.DictReader(file)]
    half = [row for row in rows if row[1] >= rows[-1][1] / 2]
    return (half[-1][0] - half[0][0]) / (half[-1][1] - half[0][1])


def theirs(algorithm: str, env: str, seconds: float) -> float:
    """Stable-Baselines3's algorithm with its defaults, 8 environments and one thread."""
    import stable_baselines3  # only the process that measures it needs it
    import torch
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)
    kind: Any = getattr(stable_baselines3, algorithm.removeprefix("SB3 "))
    model = kind("MlpPolicy", make_vec_env(env, n_envs=_ENVS, seed=0), seed=0, device="cpu")
    model.learn(2 * model.n_steps * _ENVS)
    begin, begin_s = model.num_timesteps, time.perf_counter()
    while time.perf_counter() - begin_s < seconds:
        model.learn(model.n_steps * _ENVS, reset_num_timesteps=False)
    return float(model.num_timesteps - begin) / (time.perf_counter() - begin_s)


def main() -> None:
    """Measure one."""
    name, work, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    env, *more = work.split()
    is_ours = name in _OURS
    rate = ours((*_OURS[name], *more), env, seconds) if is_ours else theirs(name, env, seconds)
    sys.stdout.write(f"{rate}\n")


if __name__ == "__main__":
    main()
