"""An hour of 2 x 8 environments: ``python -m reliability.soak --minutes 60``.

Every process's own memory is read once a second: ``RssAnon``, for the files of a replay are mapped,
and are the kernel's to keep or to drop. Its slope is that of the lowest values of twenty
equal parts of the last three quarters, with its interval of 95 %: what an update needs for a moment
comes and goes. All that was read is in ``memory.csv``.
"""

import argparse
import csv
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from reliability.commands import Commands, rows, wait_for
from reliability.run_files import unbalanced
from reliability.trial import Result, folder, tell
from scipy import stats

_EVERY_S, _PARTS = 1.0, 20
_LEAST_MINUTES = 30.0  # before that everything still grows, and slopes are shown only
_MOST_PER_HOUR = 1.0  # MB
Sample = tuple[float, float]  # hours, MB


def soak(variant: str, minutes: float, env: str, place: Path) -> Result:
    """One run of a variant."""
    result = Result(f"soak, {variant}", "memory of no process grows by 1 MB/h; accounts balance")
    path, memory = place / variant, dict[str, list[Sample]]()
    with Commands(place) as commands:
        learner = commands.start(
            "learner", "--env", env, "--variant", variant, "--n", "2", "--envs", "8",
            "--total-steps", "1000000000", "--listen", commands.endpoint, "--run-dir", str(path),
            "--metrics-port", "-1",
        )  # fmt: skip
        actor = commands.start(
            "actor",
            "--n",
            "2",
            "--envs",
            "8",
            "--connect",
            commands.endpoint,
            "--metrics-port",
            "-1",
        )
        wait_for(lambda: rows(path / "updates.csv") >= 3, "the first updates", 600.0)
        names = {learner.process.pid: "learner", actor.process.pid: "supervisor"}
        names |= {each.pid: f"worker {n}" for n, each in enumerate(actor.workers())}
        begin_s = time.monotonic()
        while (now_s := time.monotonic() - begin_s) < 60 * minutes:
            for pid, name in names.items():
                memory.setdefault(name, []).append((now_s / 3600, _own_mb(pid)))
            time.sleep(_EVERY_S)
        result.figures["updates"] = str(rows(path / "updates.csv"))
        code = learner.end(signal.SIGINT)
        result.add("" if code == 130 else f"exit code {code}", unbalanced(path), of="the end")
    with (path / "memory.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("process", "hours", "mb"))
        writer.writerows((name, *each) for name, samples in memory.items() for each in samples)
    for name, samples in memory.items():
        slope, low, high = line(samples[len(samples) // 4 :])
        found = f"{samples[-1][1]:.0f} MB, {slope:+.2f} [{low:+.2f}, {high:+.2f}] MB/h"
        result.figures[name] = found
        grows = minutes >= _LEAST_MINUTES and high > _MOST_PER_HOUR
        result.add(
            "may grow by more than 1 MB/h" if grows else "", of=f"{name}: {result.figures[name]}"
        )
    return result


def line(samples: Sequence[Sample]) -> tuple[float, float, float]:
    """Slope of the lowest values of equal parts, and its interval of 95 %: Theil and Sen's.

    Few parts in which nothing was given back do not count for much.
    """
    parts = np.array_split(np.asarray(samples), min(_PARTS, len(samples)))
    hours, size = np.array([part[part[:, 1].argmin()] for part in parts]).T
    slope, _, low, high = stats.theilslopes(size, hours)
    return float(slope), float(low), float(high)


def _own_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text()
    return float(text.split("RssAnon:")[1].split()[0]) / 1024


def main() -> None:
    """Parse, soak, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=0.5)
    parser.add_argument("--env", default="Hopper-v5")
    options = parser.parse_args()
    with folder() as place:
        variants = ("on-policy", "off-policy")
        results = [soak(each, options.minutes, options.env, place) for each in variants]
    tell(results)


if __name__ == "__main__":
    main()
