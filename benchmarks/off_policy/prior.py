"""What prior data bring on Hopper-v5: python benchmarks/off_policy/prior.py --out runs/prior.

A good policy is trained on-policy until an evaluation returns 3,200. It plays episodes, by turns of
its mean action and as in training, until there are 20,000 transitions; they become a Minari data
set, and that becomes prior data. Then one run after the other learns off-policy, with them and
without, until ten episodes of the mean action return 3,000: evaluated every 2,500 steps. What has
finished is not run again, what was interrupted goes on. The last lines are the table.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from a2s import load_policy

ENV, TRANSITIONS, WANTED, SEEDS, MODES = (
    "Hopper-v5",
    20_000,
    3000,
    (20, 21, 22),
    ("mean", "behaviour"),
)
DATA_SET = "good-v0"
GOOD = (
    "--n", "1", "--envs", "16", "--seed", "10", "--total-steps", "1000000",
    "--evaluate-every", "50000", "--stop-at-return", "3200",
)  # fmt: skip
LEARNS = (
    "--variant", "off-policy", "--n", "1", "--envs", "1", "--total-steps", "100000",
    "--evaluate-every", "2500", "--stop-at-return", str(WANTED),
)  # fmt: skip


def a2s(*arguments: str) -> None:
    """Run a command to its end."""
    subprocess.run([sys.executable, "-m", "a2s.cli", *arguments], check=True, stdout=sys.stderr)


def train(path: Path, *options: str) -> None:
    """Train, go on, or do nothing because it has finished."""
    summary = path / "summary.json"
    if summary.exists() and json.loads(summary.read_text())["finished"]:
        return
    how = ("--resume",) if (path / "checkpoints").exists() else ("--env", ENV, *options)
    a2s("train", *how, "--run-dir", str(path), "--metrics-port", "-1")


def play(run: Path, root: Path) -> None:
    """Play episodes with a policy, and keep them as a Minari data set."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari
        from minari.data_collector import EpisodeBuffer
    policies = [load_policy(run, mode, seed=0) for mode in MODES]
    env: Any = gymnasium.make(ENV)
    episodes: list[Any] = []
    steps, returns = 0, []
    while steps < TRANSITIONS:
        policy = policies[len(episodes) % len(MODES)]
        obs = [env.reset(seed=1000 + len(episodes))[0]]
        ends: list[tuple[bool, bool]] = []
        actions, rewards = [], []
        while not (ends and any(ends[-1])) and steps < TRANSITIONS:
            actions.append(policy(obs[-1]))
            after, reward, terminated, truncated, _ = env.step(actions[-1])
            obs.append(after)
            rewards.append(float(reward))
            steps += 1
            ends.append((terminated, truncated or steps == TRANSITIONS))
        returns.append(sum(rewards))
        episodes.append(
            EpisodeBuffer(
                id=len(episodes), observations=np.array(obs), actions=np.array(actions),
                rewards=rewards, terminations=[end[0] for end in ends],
                truncations=[end[1] for end in ends],
            )
        )  # fmt: skip
    for first, mode in enumerate(MODES):
        found = returns[:-1][first :: len(MODES)]  # the last one is cut
        sys.stdout.write(f"{mode}: {len(found)} episodes, mean return {np.mean(found):.0f}\n")
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            dataset_id=DATA_SET, buffer=episodes, env=env.spec,
            observation_space=env.observation_space, action_space=env.action_space,
        )  # fmt: skip


def reached(path: Path) -> str:
    """Steps to the first evaluation that is good enough; else how good the best was so far."""
    if not (path / "evaluations.csv").exists():
        return "-"
    with (path / "evaluations.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["mode"] == "mean"]
    good = [row["env_steps"] for row in rows if float(row["return_mean"]) >= WANTED]
    if good:
        return f"{int(good[0]):,}"
    best = max((float(row["return_mean"]) for row in rows), default=0.0)
    return f"not in {int(rows[-1]['env_steps']) if rows else 0:,} (best {best:.0f})"


def main() -> None:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/prior"))
    parser.add_argument("--arms", nargs="*", default=["with", "without"])
    parser.add_argument("--seeds", nargs="*", type=int, default=SEEDS)
    parser.add_argument("--draw", action="store_true", help="run nothing, only write the table")
    given = parser.parse_args()
    out, prior = given.out.absolute(), given.out.absolute() / "prior"
    if not given.draw:
        train(out / "source", *GOOD)
        if not prior.exists():
            play(out / "source", out / "minari")
            a2s("replay", "import", str(out / "minari" / DATA_SET), "-o", str(prior))
        for arm in given.arms:
            for seed in given.seeds:
                more = ("--prior", str(prior)) if arm == "with" else ()
                train(out / f"{arm}-{seed}", *LEARNS, "--seed", str(seed), *more)
    sys.stdout.write("| steps to 3,000 | with prior data | without |\n|---|---|---|\n")
    for seed in SEEDS:
        cells = (reached(out / f"{arm}-{seed}") for arm in ("with", "without"))
        sys.stdout.write(f"| seed {seed} | {' | '.join(cells)} |\n")


if __name__ == "__main__":
    main()
