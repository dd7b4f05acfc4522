"""Repeat the results: python benchmarks/run.py SUITE --out runs/bench -j 2.

Every run is `a2s train` with fixed seeds, one actor process and one thread, so that several fit on
a machine. A run that has finished is not run again; one that was interrupted is resumed. What is
left behind in the folder of the suite: one row a run in results.csv, the episodes of every run, and
a table and the curves of the suite.
"""

import argparse
import csv
import gzip
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from curves import curves
from suites import ARMS, PENDULUM, REFERENCE, SUITES, kept_episodes, kept_evaluations, name_of
from table import tables

from a2s.commands.evaluate import evaluate_run

HERE = Path(__file__).parent
CLI = ("-m", "a2s.cli")
MODES = ("mean", "best-of-k")
EVALUATION_SEED = 2000
COLUMNS = (
    "suite", "env", "label", "seed", "env_steps", "commit", "options", "mean", "mean_std",
    "best_of_k", "best_of_k_std", "first_1000", "return_last_tenth", "return_best", "recoveries",
    "wall_s",
)  # fmt: skip


def place(suite: str, env: str, label: str, seed: int, out: Path) -> Path:
    """Directory of a run."""
    return out / name_of(suite, env, label, seed)


def run_one(suite: str, env: str, label: str, seed: int, out: Path) -> dict[str, object]:
    """Train and evaluate one seed, unless that was done before."""
    path = place(suite, env, label, seed, out)
    if label == REFERENCE:
        return _reference(suite, env, seed, path)
    options = SUITES[suite].options(env, label, seed)
    shorter = SUITES[suite].continues
    if shorter is not None and not (path / "config.toml").exists():
        _go_on(place(shorter, env, label, seed, out), path)
    commit = _commit(path)
    if not _is_finished(path):
        resume = ("--resume",) if (path / "checkpoints").exists() else ()
        where = ("--run-dir", str(path), "--metrics-port", "-1", "--json")
        program = (str(HERE / "arms.py"), label) if label in ARMS else CLI
        _a2s("train", *options, *resume, *where, program=program)
    how = ("--episodes", "10", "--seed", "1000", "--json")
    results = {
        mode: json.loads(_a2s("evaluate", str(path), "--mode", mode, *how)) for mode in MODES
    }
    summary = json.loads((path / "summary.json").read_text())
    if env != PENDULUM and SUITES[suite].keep_every:
        _evaluate_kept(path, kept_evaluations(HERE / SUITES[suite].folder, suite, path.name))
    return {
        "suite": suite,
        "env": env,
        "label": label,
        "seed": seed,
        "env_steps": summary["env_steps"],
        "commit": commit,
        "options": " ".join(options),
        "mean": round(results["mean"]["mean"], 1),
        "mean_std": round(results["mean"]["std"], 1),
        "best_of_k": round(results["best-of-k"]["mean"], 1),
        "best_of_k_std": round(results["best-of-k"]["std"], 1),
        "first_1000": _first_solved(path) if env == PENDULUM else None,
        "return_last_tenth": _last_tenth(path, suite, summary["env_steps"]),
        "return_best": round(summary["return_best"], 1),
        "recoveries": summary["recoveries"],
        "wall_s": round(summary["wall_s"]),
    }


def _go_on(shorter: Path, path: Path) -> None:
    """Begin with a copy of a run of fewer steps, if it has finished."""
    if _is_finished(shorter):
        shutil.copytree(shorter, path, dirs_exist_ok=True)
        (path / "summary.json").unlink()


def _is_finished(path: Path) -> bool:
    file = path / "summary.json"
    return file.exists() and bool(json.loads(file.read_text())["finished"])


def _reference(suite: str, env: str, seed: int, path: Path) -> dict[str, object]:
    """The same of Stable-Baselines3's SAC, which writes the same files."""
    commit, steps = _commit(path), SUITES[suite].steps
    options = ("--env", env, "--total-steps", str(steps), "--seed", str(seed))
    if not (path / "summary.json").exists():
        script = [sys.executable, str(HERE / "sb3_sac.py"), *options, "--run-dir", str(path)]
        subprocess.run(script, check=True, stdout=sys.stderr)
    return {
        "suite": suite,
        "env": env,
        "label": REFERENCE,
        "seed": seed,
        "commit": commit,
        "options": " ".join(options),
        "return_last_tenth": _last_tenth(path, suite, steps),
        **json.loads((path / "summary.json").read_text()),
    }


def _first_solved(path: Path) -> int | None:
    """Steps after which the mean action first reached 1000 in all of 10 fresh episodes."""
    for policy in sorted(path.glob("policies/*/policy.onnx")):
        said = _a2s("evaluate", str(policy), "--episodes", "10", "--seed", "1000", "--json")
        if json.loads(said)["mean"] == 1000.0:
            return int(policy.parent.name)
    return None


def _evaluate_kept(path: Path, output: Path) -> None:
    """Evaluate every kept policy by its mean action on the same 10 fresh episodes."""
    if output.exists():
        return
    with (path / "updates.csv").open(newline="") as file:
        wall_s = {row["env_steps"]: row["wall_s"] for row in csv.DictReader(file)}
    lines = ["env_steps,mean,wall_s"]
    for policy in sorted(path.glob("policies/*/policy.onnx")):
        steps = str(int(policy.parent.name))
        if steps not in wall_s:
            continue  # of an update that a kill undid
        found = evaluate_run(
            policy, {}, episodes=10, mode="mean", weights="latest", seed=EVALUATION_SEED
        )
        if found["unusable_steps"]:
            sys.exit(f"{policy}: {found['unusable_steps']} steps could not be used, expected none")
        lines.append(f"{steps},{found['mean']:.1f},{wall_s[steps]}")
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text("\n".join(lines) + "\n")


def _a2s(*arguments: str, program: tuple[str, ...] = CLI) -> str:
    done = subprocess.run(
        [sys.executable, *program, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"a2s {' '.join(arguments)}: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout.splitlines()[-1]


def _commit(path: Path) -> str:
    """Write down the commit that a run is begun with."""
    path.mkdir(parents=True, exist_ok=True)
    file = path / "commit"
    if not file.exists():
        head = ["git", "-C", str(HERE), "rev-parse", "--short", "HEAD"]
        file.write_text(subprocess.check_output(head, text=True).strip())
    return file.read_text()


def _last_tenth(path: Path, suite: str, env_steps: int) -> float | None:
    """Average the training returns of the last tenth of a run, and keep all its episodes."""
    text = (path / "episodes.csv").read_text()
    kept = kept_episodes(HERE / SUITES[suite].folder, suite, path.name)
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_bytes(gzip.compress(text.encode(), mtime=0))
    rows = list(csv.DictReader(text.splitlines()))
    returns = [float(r["return"]) for r in rows if int(r["env_steps"]) > 0.9 * env_steps]
    return round(sum(returns) / len(returns), 1) if returns else None


def main() -> None:
    """Run what is missing of a suite, rewrite its rows of results.csv, its table and curves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("-j", type=int, default=1, help="runs at once")
    parser.add_argument("--envs", nargs="*", help="only these environments")
    parser.add_argument("--labels", nargs="*", help="only these labels")
    parser.add_argument("--seeds", nargs="*", type=int, help="only these seeds")
    parser.add_argument("--draw", action="store_true", help="run nothing, only table and curves")
    arguments = parser.parse_args()
    suite = SUITES[arguments.suite]
    labels = arguments.labels or suite.labels
    jobs = [
        (arguments.suite, env, label, seed, arguments.out)
        for seed in arguments.seeds or suite.seeds
        for env in arguments.envs or suite.envs
        for label in labels
        if not arguments.draw
    ]
    folder = HERE / suite.folder
    table = folder / "results.csv"
    with ThreadPoolExecutor(arguments.j) as pool:
        for row in pool.map(lambda job: run_one(*job), jobs):
            _keep(table, row)
            sys.stdout.write(f"{row['env']} {row['label']} {row['seed']}: {row['mean']}\n")
            sys.stdout.flush()
    (folder / f"{arguments.suite}.md").write_text(tables(table, arguments.suite, suite.labels))
    curves(folder, arguments.suite, labels, folder / f"{arguments.suite}.png")


def _keep(table: Path, row: dict[str, object]) -> None:
    key = ("suite", "env", "label", "seed")
    rows: list[dict[str, object]] = []
    if table.exists():
        with table.open(newline="") as file:
            rows = [dict(r) for r in csv.DictReader(file)]
    rows = [r for r in rows if any(str(r[k]) != str(row[k]) for k in key)] + [row]
    rows.sort(key=lambda r: [str(r[k]) for k in key])
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
