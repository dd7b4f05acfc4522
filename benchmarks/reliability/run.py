"""Repeat the trials of reliability: python benchmarks/reliability/run.py [TRIAL...] [--full].

Each trial is a program of its own, ``reliability.TRIAL``, in a short form unless ``--full``. What
comes out is printed, a line for each result, and goes into results.csv and the table of README.md,
both beside this file: an earlier result of the same trial is replaced, unless it was full and this
one is not. With the Python of a checkout: `make setup`, then .venv/bin/python.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS, README = HERE / "results.csv", HERE / "README.md"
TRIALS: dict[str, tuple[str, str]] = {  # short, full
    "kills": ("--scripted 6 --real 3", "--scripted 100 --real 100"),
    "workers": ("--count 3", "--count 100"),
    "signals": ("--count 10", "--count 200"),
    "full_disk": ("--stride 40", "--stride 1 --real-stride 5"),
    "bytes": ("--look 50 --resume 8000", "--look 1 --resume 200"),
    "fuzz": ("--decode 20000 --live 2000", "--decode 1000000 --live 100000"),
    "pauses": ("--pause 5 --away 5", "--pause 30 --away 60"),
    "soak": ("--minutes 0.5", "--minutes 60"),
    "links": ("--partition 10 --seconds 20", "--partition 10 60 --seconds 300"),  # needs root
}
COLUMNS = (
    "program", "trial", "must_hold", "count", "failed", "figures", "first_failure", "options",
    "full", "commit",
)  # fmt: skip
BEGIN, END = "<!-- results: run.py writes them -->\n", "<!-- end of results -->\n"
Row = dict[str, str]


def run(program: str, options: str, *, full: bool) -> list[Row]:
    """Run one program; a row for each of its results."""
    command = [sys.executable, "-m", f"reliability.{program}", *options.split()]
    paths = (ROOT / "src", ROOT / "benchmarks", ROOT / "tests" / "plugin")
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        command, cwd=ROOT, env=environ, stdout=subprocess.PIPE, text=True, check=False
    )
    lines = done.stdout.splitlines()
    if not lines:
        sys.exit(f"{program}: ended with code {done.returncode} and no result; see above")
    return [
        {
            "program": program,
            "trial": found["trial"],
            "must_hold": found["must_hold"],
            "count": str(found["count"]),
            "failed": str(len(found["failures"])),
            "figures": "; ".join(f"{k}: {v}" for k, v in found["figures"].items()),
            "first_failure": (found["failures"] or [""])[0][:300],
            "options": options,
            "full": str(full),
            "commit": commit(),
        }
        for found in json.loads(lines[-1])
    ]


def commit() -> str:
    """Name the commit of the checkout; with changes it has a +."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":!benchmarks/reliability")
    return git("rev-parse", "--short", "HEAD").strip() + "+" * bool(changed)


def kept() -> list[Row]:
    """Earlier results."""
    if not RESULTS.exists():
        return []
    with RESULTS.open(newline="") as file:
        return list(csv.DictReader(file))


def keep(rows: list[Row]) -> None:
    """Replace earlier results of the same trials, then write the table."""
    found = {row["trial"]: row for row in kept()}
    for row in rows:
        earlier = found.get(row["trial"])
        if earlier is None or row["full"] == "True" or earlier["full"] != "True":
            found[row["trial"]] = row
    order = list(TRIALS)
    ordered = sorted(found.values(), key=lambda row: order.index(row["program"]))
    with RESULTS.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(ordered)
    text = README.read_text()
    before, rest = text.split(BEGIN)
    README.write_text(before + BEGIN + table(ordered) + END + rest.split(END)[1])


def held(row: Row) -> str:
    """How often it held, or failed."""
    if row["failed"] == "0":
        return f"held {row['count']} times"
    return f"{row['count']} times, {row['failed']} failed"


def line_of(row: Row) -> str:
    """A result for who waits for it."""
    first = row["first_failure"] and f"; first: {row['first_failure']}"
    return f"{row['trial']}: {held(row)}{first}"


def table(rows: list[Row]) -> str:
    """The results as a table of Markdown."""
    lines = ["| trial | must hold | options | result | commit |", "|---|---|---|---|---|"]
    for row in rows:
        first = row["first_failure"] and f"first: {row['first_failure']}"
        parts = [held(row), row["figures"], first]
        result = ". ".join(filter(None, parts)).replace("|", "\\|").replace("\n", " ")
        length = "full" if row["full"] == "True" else "short"
        command = f"{length}: `{row['program']} {row['options']}`"
        cells = (row["trial"], row["must_hold"], command, result, row["commit"])
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is asked for, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trials", nargs="*", choices=[*TRIALS, []], help="all, if none is named")
    parser.add_argument("--full", action="store_true", help="takes a day")
    options = parser.parse_args()
    failed = False
    for program in options.trials or TRIALS:
        rows = run(program, TRIALS[program][options.full], full=options.full)
        keep(rows)
        sys.stdout.writelines(f"{line_of(row)}\n" for row in rows)
        sys.stdout.flush()
        failed |= any(row["failed"] != "0" for row in rows)
    sys.exit(failed)


if __name__ == "__main__":
    main()
