"""kill -9 of an actor's worker: ``python -m reliability.workers --count 100``.

Each time one of two workers, once both have had a segment accepted.
"""

import argparse
import os
import random
import signal
import time
from pathlib import Path

import psutil
from reliability.commands import Commands, rows, wait_for
from reliability.run_files import accounts_disagree, answered, unbalanced
from reliability.trial import Result, folder, tell
from system_helpers import FAST, REACH, Command


def kill(count: int, seed: int, place: Path) -> Result:
    """Kill, and wait for the replacement to act, so many times."""
    result = Result(
        "kill -9 of a worker",
        "replaced and acting, accounts balance at the end; p95 below 4 s",
    )
    rng, path, acting_s = random.Random(seed), place / "run", list[float]()
    with Commands(place) as commands:
        learner = commands.start(
            "learner", *REACH, *FAST, "--n", "2", "--total-steps", "100000000", "--listen",
            commands.endpoint, "--run-dir", str(path), "--metrics-port", "-1",
        )  # fmt: skip
        actor = commands.start(
            "actor", "--n", "2", "--connect", commands.endpoint, "--metrics-port", "-1"
        )
        wait_for(lambda: rows(path / "updates.csv") >= 3, "the first updates")
        for _ in range(count):
            before, victim = _senders(path), rng.choice(_workers(actor))
            os.kill(victim.pid, signal.SIGKILL)
            begin_s = time.monotonic()
            try:
                wait_for(lambda: len(_senders(path)) > len(before), "a replacement that acts")  # noqa: B023
            except TimeoutError as error:
                result.add(str(error), actor.text()[-300:])
                break
            acting_s.append(time.monotonic() - begin_s)
            result.add()
        code = learner.end(signal.SIGINT)
        result.add("" if code == 130 else f"exit code {code}", unbalanced(path), of="the end")
        result.add(accounts_disagree(path), of="what was kept")
    result.quantiles("acts again after", acting_s)
    return result


def _senders(path: Path) -> set[str]:
    return {actor for actor, _, verdict, _ in answered(path) if verdict == "accepted"}


def _workers(actor: Command) -> list[psutil.Process]:
    """Both, once they are there."""
    wait_for(lambda: len(actor.workers()) == 2, "two workers")
    return actor.workers()


def main() -> None:
    """Parse, kill, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with folder() as place:
        result = kill(options.count, options.seed, place)
    tell([result])


if __name__ == "__main__":
    main()
