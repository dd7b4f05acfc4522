"""Repeat the tables of speed: python benchmarks/speed/run.py [TABLE...] [--rounds N].

Makes an environment with a2s and its peers (requirements.txt) in build/speed, measures, and writes
results.csv and the tables of README.md. Contenders of a table take turns, each in processes of its
own, so that a ratio is of figures of one round. Run it on an otherwise idle machine.
"""

import argparse
import csv
import json
import os
import platform
import statistics
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PLACE = ROOT / "build" / "speed"
PYTHON = PLACE / "bin" / "python"
RESULTS, README = HERE / "results.csv", HERE / "README.md"
COLUMNS = ("table", "work", "contender", "round", "value", "unit", "commit", "machine")
BEGIN, END = "<!-- results: run.py writes them -->\n", "<!-- end of results -->\n"
Row = dict[str, str]


class Table(NamedTuple):
    """Contenders, as ``module: name``, for each kind of work; ratios are to the ``against``.

    A contender is told the work, the ``seconds``, and the number of the round.
    """

    contenders: tuple[str, ...]
    against: tuple[str, ...]
    works: tuple[str, ...]
    unit: str
    seconds: float


_ENVS = ("HalfCheetah-v5", "Hopper-v5", "Ant-v5")
TABLES = {
    "loops": Table(
        (
            "loops: a2s", "loops: a2s a2c", "loops: SB3 PPO", "loops: SB3 A2C",
            "stepping: gym.make",
        ),
        ("loops: SB3 PPO", "stepping: gym.make"), _ENVS, "env steps/s", 6.0,
    ),
    "acting": Table(
        (
            "stepping: acting, K 10", "stepping: fast path", "stepping: gym.make",
            "stepping: physics", "stepping: EnvPool",
        ),
        ("stepping: EnvPool", "stepping: gym.make", "stepping: physics"), _ENVS, "env steps/s", 3.0,
    ),
    "growth": Table(
        ("loops: a2s", "loops: a2s a2c"), ("loops: a2s a2c",),
        tuple(
            f"{env} --n {n} --envs {envs}"
            for env, n, envs in (
                *(("HalfCheetah-v5", 1, envs) for envs in (1, 4, 16, 64)),
                *(("HalfCheetah-v5", n, 16 // n) for n in (2, 4, 8)),
                ("Humanoid-v5", 1, 16),
            )
        ),
        "env steps/s", 4.0,
    ),
    "suggestions": Table(
        ("loops: a2s",), (),
        tuple(f"HalfCheetah-v5 --suggestions {count}" for count in (1, 4, 10, 64, 256)),
        "env steps/s", 4.0,
    ),
    "rows": Table(
        ("sampling: uniform", "sampling: prioritised"), ("sampling: uniform",),
        ("10000", "100000", "1000000", "4000000"), "batches/s", 3.0,
    ),
    "until-cheetah": Table(
        ("until: a2s", "until: a2s a2c", "until: sb3 PPO"),
        ("until: a2s a2c", "until: sb3 PPO"),
        ("HalfCheetah-v5:3000",), "s", 60.0,
    ),
    "until-hopper": Table(
        ("until: a2s", "until: sb3 PPO", "until: sb3 SAC", "until: sbx SAC"),
        ("until: sb3 PPO", "until: sb3 SAC", "until: sbx SAC"),
        ("Hopper-v5:2000",), "s", 60.0,
    ),
    "selecting": Table(
        ("selecting: a2s", "selecting: torch"), ("selecting: torch",),
        ("10:1", "10:8", "1:8", "64:8", "256:8"), "observations/s", 1.0,
    ),
}  # fmt: skip
SUITES = ("learner", "wire", "replay", "startup")  # of ``a2s bench``, which takes turns itself
LOADS = (1, 10, 100, 300, 1000)  # simulated actors of a learner that learns


def make_environment() -> None:
    """Install a2s and its peers into build/speed, unless they are there."""
    if not PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", str(PLACE)], check=True)
    wanted = ["-c", "constraints.txt", "-e", ".[learner]", "-r", str(HERE / "requirements.txt")]
    faster = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", str(PYTHON)]
    pip = [str(PYTHON), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if subprocess.run([*faster, *wanted], cwd=ROOT, check=False).returncode:
        subprocess.run([*pip, *wanted], cwd=ROOT, check=True)


def output_of(*words: str) -> str:
    """Run a module of this folder or of a2s there; the last line that it prints."""
    environ = {**os.environ, "PYTHONPATH": str(HERE.parent), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [str(PYTHON), "-m", *words], cwd=ROOT, env=environ, stdout=subprocess.PIPE, text=True,
        check=True,
    )  # fmt: skip
    return done.stdout.splitlines()[-1]


def measure(name: str, rounds: int) -> list[Row]:
    """All rounds of one table; what is printed meanwhile tells how it goes."""
    table, found = TABLES[name], []
    for work in table.works:
        for turn in range(rounds):
            for contender in table.contenders:
                module, who = contender.split(": ", 1)
                how = str(table.seconds), str(turn)
                value = output_of(f"speed.{module}", who, work, *how)
                found.append(_row(name, work, contender, turn, value, table.unit))
                sys.stdout.write(f"{name} {work} {turn} {contender} {float(value):,.0f}\n")
                sys.stdout.flush()
    return found


def measure_suite(name: str, rounds: int) -> list[Row]:
    """The medians of a suite of ``a2s bench``, with its ratios to the fastest other."""
    rows = json.loads(output_of("a2s.cli", "bench", name, "--rounds", str(rounds), "--json"))
    return [
        row
        for each in rows
        for row in (
            _row(f"bench {name}", "", each["name"], 0, str(each["value"]), each["unit"]),
            _row(f"bench {name}", "ratio", each["name"], 0, str(each["ratio"]), ""),
        )
        if row["value"] != "None"
    ]


def measure_loads(rounds: int) -> list[Row]:
    """Simulated actors of a learner that learns."""
    found = []
    for actors in LOADS:
        options = ("--actors", str(actors), "--rounds", str(rounds), "--seconds", "2", "--json")
        for each in json.loads(output_of("a2s.cli", "bench", "wire", *options)):
            name = each["name"].split(": ", 1)[1]
            value = str(each["value"])
            found.append(_row("load", str(actors), name, 0, value, each["unit"]))
    return found


def _row(table: str, work: str, contender: str, turn: int, value: str, unit: str) -> Row:
    cells = (table, work, contender, str(turn), value, unit, commit(), machine())
    return dict(zip(COLUMNS, cells, strict=True))


def commit() -> str:
    """Name the commit of the checkout; with changes it has a +."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":!benchmarks/speed")
    return git("rev-parse", "--short", "HEAD").strip() + "+" * bool(changed)


def machine() -> str:
    """Name the processor and how many of its cores are here."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(": ", 1)[1] for line in lines if line.startswith("model name")]
    return f"{os.cpu_count()} cores, {names[0] if names else platform.processor()}"


def keep(rows: list[Row]) -> None:
    """Replace earlier results of the same tables, then write the page."""
    earlier: list[Row] = []
    if RESULTS.exists():
        with RESULTS.open(newline="") as file:
            earlier = list(csv.DictReader(file))
    new = {row["table"] for row in rows}
    together = [row for row in earlier if row["table"] not in new] + rows
    with RESULTS.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(together)
    before, rest = README.read_text().split(BEGIN)
    README.write_text(before + BEGIN + page(together) + END + rest.split(END)[1])


def page(rows: list[Row]) -> str:
    """All tables as Markdown, each with its commit and machine."""
    parts = []
    for name in dict.fromkeys(row["table"] for row in rows):
        own = [row for row in rows if row["table"] == name]
        body = rounds_table(TABLES[name], own) if name in TABLES else plain_table(own)
        about = f"Commit {own[0]['commit']}; {own[0]['machine']}."
        parts.append(f"### {name}\n\n{about}\n\n{body}\n")
    return "\n".join(parts)


def rounds_table(table: Table, rows: list[Row]) -> str:
    """Medians and ranges over the rounds, and medians of the ratios within a round."""
    heads = ["work", "contender", table.unit, "range", *(f"to {who}" for who in table.against)]
    lines = [_line(heads), _line(["---"] * len(heads))]
    values: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        values.setdefault((row["work"], row["contender"]), []).append(float(row["value"]))
    for (work, contender), found in values.items():
        ratios = [
            statistics.median(a / b for a, b in zip(found, values[work, who], strict=True))
            for who in table.against
        ]
        middle, span = statistics.median(found), f"{min(found):,.0f} to {max(found):,.0f}"
        numbers = (f"{ratio:.2f}" for ratio in ratios)
        lines.append(_line([work, contender, f"{middle:,.0f}", span, *numbers]))
    return "\n".join(lines) + f"\n\n{_rounds(rows)} rounds."


def plain_table(rows: list[Row]) -> str:
    """What ``a2s bench`` says: its medians, and its ratios where there are any."""
    ratios = {row["contender"]: row["value"] for row in rows if row["work"] == "ratio"}
    lines = [_line(["work", "what", "value", "to the fastest other"]), _line(["---"] * 4)]
    for row in rows:
        if row["work"] != "ratio":
            value = f"{float(row['value']):,.4g} {row['unit']}" if row["value"] != "None" else "-"
            ratio = ratios.get(row["contender"], "")
            lines.append(_line([row["work"], row["contender"], value, ratio]))
    return "\n".join(lines)


def _rounds(rows: list[Row]) -> int:
    return 1 + max(int(row["round"]) for row in rows)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Make the environment, and measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = [*TABLES, *(f"bench-{suite}" for suite in SUITES), "load", "flames"]
    parser.add_argument("tables", nargs="*", choices=[*names, []], help="all, if none is named")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    make_environment()
    for name in options.tables or names:
        if name in TABLES:
            keep(measure(name, options.rounds))
        elif name == "load":
            keep(measure_loads(options.rounds))
        elif name == "flames":
            output_of("speed.flames")
        else:
            keep(measure_suite(name.removeprefix("bench-"), options.rounds))


if __name__ == "__main__":
    main()
