"""Seconds to a return: ``python -m speed.until CONTENDER ENV:RETURN LIMIT SEED`` prints them.

From the start of the program to the first mean of ten episodes by the mean action, looked at every
10,240 steps, that is at least RETURN; LIMIT where that takes longer. What the others spend on
looking is not counted: a2s looks in a process of its own, and goes on.
"""

import importlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

EVERY, EPISODES, ENVS, ENDLESS = 10_240, 10, 8, 10**9
_LIBRARIES = {"sb3": "stable_baselines3", "sbx": "sbx"}
_THEIRS = ("sb3 PPO", "sb3 SAC", "sbx SAC")
_OURS: dict[str, tuple[str, ...]] = {
    "a2s": (),
    "a2s a2c": ("--algo", "a2c"),
}
CONTENDERS = (*_OURS, *_THEIRS)


def ours(options: tuple[str, ...], env: str, wanted: float, seed: int, limit_s: float) -> float:
    """From the command to its end, with whatever it does there."""
    with tempfile.TemporaryDirectory() as folder:
        command = (
            sys.executable, "-m", "a2s.cli", "train", "--env", env, "--seed", str(seed),
            "--run-dir", str(Path(folder) / "run"), "--total-steps", str(ENDLESS),
            "--evaluate-every", str(EVERY), "--evaluation-episodes", str(EPISODES),
            "--stop-at-return", str(wanted), "--metrics-port", "-1", "--episodes", "1", *options,
        )  # fmt: skip
        begin_s = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as run:
            try:
                run.communicate(timeout=limit_s)
            except subprocess.TimeoutExpired:
                run.terminate()
                run.communicate()
                return limit_s
        if run.returncode:
            sys.exit(f"{' '.join(command)}: ended with {run.returncode}")
        return time.perf_counter() - begin_s


def theirs(name: str, env: str, wanted: float, seed: int, limit_s: float) -> float:
    """A library's algorithm with its defaults; PPO with 8 environments, SAC with one."""
    begin_s, looking_s = time.perf_counter(), 0.0

    def spent_s() -> float:
        return time.perf_counter() - begin_s - looking_s

    import torch  # this and the others take seconds: counted
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    library, algorithm = name.split()
    kinds: Any = importlib.import_module(_LIBRARIES[library])
    torch.set_num_threads(1)
    count = ENVS if algorithm == "PPO" else 1
    alone = make_vec_env(env, seed=seed + 1000)
    model = getattr(kinds, algorithm)("MlpPolicy", make_vec_env(env, n_envs=count, seed=seed))
    while True:
        model.learn(EVERY, reset_num_timesteps=False, callback=lambda *_: spent_s() < limit_s)
        if spent_s() >= limit_s:
            return limit_s
        looked_s = time.perf_counter()
        mean, _ = evaluate_policy(model, alone, EPISODES)
        looking_s += time.perf_counter() - looked_s
        if float(mean) >= wanted:
            return spent_s()


def main() -> None:
    """Measure one."""
    name, work, limit_s, seed = sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
    env, wanted = work.split(":")
    how = (env, float(wanted), seed, limit_s)
    seconds = ours(_OURS[name], *how) if name in _OURS else theirs(name, *how)
    sys.stdout.write(f"{seconds}\n")


if __name__ == "__main__":
    main()
