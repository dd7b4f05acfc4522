"""Compares lockstep runs of two checkouts: the same episodes, and the same weights to the bit?

``.venv/bin/python benchmarks/same.py OLD NEW``, from anywhere; OLD and NEW are work trees of this
repository, of which the packages of this virtual environment are used.
"""

import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

COMMAND = "train --env Hopper-v5 --seed 7 --lockstep --n 1 --envs 4 --episodes 2 --metrics-port -1"
CASES = {
    "default": "--total-steps 20000",
    "a2c": "--total-steps 20000 --algo a2c",
    "authors": "--total-steps 8000 --preset authors",
    "paper": "--total-steps 8000 --preset paper",
    "off-policy": "--total-steps 3000 --variant off-policy --set warm_up_steps=1000",
}


def outcome(tree: Path, options: str, path: Path) -> tuple[list[dict[str, str]], str]:
    """Rows of ``episodes.csv`` without their times, and the hash of the final weights."""
    arguments = [*COMMAND.split(), *options.split(), "--json", "--run-dir", str(path)]
    command = [sys.executable, "-P", "-m", "a2s.cli", *arguments]
    env = {**os.environ, "PYTHONPATH": str(tree / "src")}
    run = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if run.returncode:
        sys.exit(f"{tree}: {run.stderr}")
    with (path / "episodes.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]
    return rows, json.loads((path / "summary.json").read_text())["weights_sha256"]


def main() -> None:
    """Print one line a case."""
    trees = [Path(argument).resolve() for argument in sys.argv[1:3]]
    with tempfile.TemporaryDirectory() as folder:
        for case, options in CASES.items():
            old, new = (
                outcome(tree, options, Path(folder) / f"{case}-{number}")
                for number, tree in enumerate(trees)
            )
            words = ["the same" if a == b else "DIFFERENT" for a, b in zip(old, new, strict=True)]
            sys.stdout.write(f"{case}: {len(old[0])} episodes {words[0]}, weights {words[1]}\n")


if __name__ == "__main__":
    main()
