"""Processes that are suspended, and a learner that is away.

``python -m reliability.pauses --pause 30 --away 60``: SIGSTOP of learner, supervisor and each
worker in turn, then the learner is killed and comes back after a while. Afterwards it learns again,
with the same workers, and the accounts balance.
"""

import argparse
import os
import signal
import time
from pathlib import Path

from reliability.commands import Commands, rows, wait_for
from reliability.run_files import accounts_disagree, unbalanced
from reliability.trial import Result, folder, tell
from system_helpers import FAST, OFF_POLICY, REACH

VARIANTS = {"on-policy": FAST, "off-policy": (*OFF_POLICY, "--set", "warm_up_steps=100")}


def pause(variant: str, pause_s: float, away_s: float, place: Path) -> Result:
    """Every process once, then the learner's absence."""
    result = Result(
        f"suspended and away, {variant}", "learns again with the same workers, accounts balance"
    )
    path = place / variant
    table = path / "updates.csv"
    with Commands(place) as commands:
        options = ("--listen", commands.endpoint, "--run-dir", str(path), "--metrics-port", "-1")
        learner = commands.start(
            "learner", *REACH, *VARIANTS[variant], "--n", "2", "--total-steps", "100000000",
            *options,
        )  # fmt: skip
        actor = commands.start(
            "actor", "--n", "2", "--connect", commands.endpoint, "--metrics-port", "-1"
        )
        wait_for(lambda: rows(table) >= 3, "the first updates")
        workers = [each.pid for each in actor.workers()]
        stopped = {"learner": learner.process.pid, "supervisor": actor.process.pid}
        stopped |= {f"worker {number}": pid for number, pid in enumerate(workers)}
        again_s = []
        for name, pid in stopped.items():
            _send(pid, signal.SIGSTOP)
            time.sleep(pause_s)
            before = rows(table)
            _send(pid, signal.SIGCONT)
            again_s.append(_until_more(result, table, before, f"{name} suspended {pause_s:.0f} s"))
        learner.process.kill()
        learner.process.wait()
        time.sleep(away_s)
        before = rows(table)
        learner = commands.start("learner", "--resume", *options)
        again_s.append(_until_more(result, table, before, f"learner away {away_s:.0f} s"))
        same = sorted(workers) == sorted(each.pid for each in actor.workers())
        code = learner.end(signal.SIGINT)
        result.add(
            "" if same else f"workers were replaced: {actor.text()[-300:]}",
            "" if code == 130 else f"exit code {code}",
            "a traceback" if "Traceback" in actor.text() + learner.text() else "",
            unbalanced(path),
            accounts_disagree(path),
            of="the end",
        )
    result.quantiles("learns again after", again_s)
    return result


def _send(pid: int, number: int) -> None:
    os.kill(pid, number)


def _until_more(result: Result, table: Path, before: int, of: str) -> float:
    """Wait for updates, more than one: the first may have been complete before."""
    took_s = 0.0
    try:
        took_s = wait_for(lambda: rows(table) > before + 2, "updates")
        result.add(of=f"{of}, again after {took_s:.1f} s")
    except TimeoutError as error:
        result.add(str(error), of=of)
    return took_s


def main() -> None:
    """Parse, pause, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pause", type=float, default=5.0, help="seconds of each suspension")
    parser.add_argument("--away", type=float, default=5.0, help="seconds without a learner")
    options = parser.parse_args()
    with folder() as place:
        results = [pause(v, options.pause, options.away, place) for v in VARIANTS]
    tell(results)


if __name__ == "__main__":
    main()
