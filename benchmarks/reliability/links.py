"""A link between learner and actors that is cut, or slow and lossy.

``python -m reliability.links --partition 10 60 --seconds 120``: learner and actors are in network
namespaces of their own (``link.py``). First both directions of the link are cut, then either one
alone, for so many seconds each; at the end they are ended while both are cut. Then so many seconds
over a link without delay or loss, and as many with 100 +- 50 ms in each direction and 2 % of the
frames lost: in async, which must keep up, and on-policy in lockstep too, to know.

These play Hopper-v5 as fast as a real one would, 2 x 2 environments of 125 steps/s: such a link has
room for their steps, and those who simulate faster than that have a nearer learner. Off-policy
there is an update for ten steps, so that the learner is not what limits; ``large`` has networks of
the default size, of which 1.7 MB go to the actors. ``--congestion cubic bbr`` does all that with
each of these; else it is the machine's.
"""

import argparse
import itertools
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from reliability.commands import Commands, rows, wait_for
from reliability.link import ACTOR, ADDRESSES, LEARNER, Link, NoLinkError, Quality
from reliability.pauses import VARIANTS
from reliability.run_files import accounts_disagree, unbalanced
from reliability.trial import Result, folder, tell
from system_helpers import REACH

CUTS = {
    "both directions": (ACTOR, LEARNER),
    "actors to learner": (ACTOR,),
    "learner to actors": (LEARNER,),
}
LOSSY = Quality(delay_s=0.1, jitter_s=0.05, loss=0.02)
HOPPER = ("--env", "Hopper-v5", "--wrapper", "reliability.real_time:RealTime")
HOPPERS = {
    "on-policy": (*HOPPER, *VARIANTS["on-policy"]),
    "off-policy": (*HOPPER, *VARIANTS["off-policy"], "--set", "utd_ratio=0.1"),
    "off-policy, large": (
        *HOPPER, "--variant", "off-policy", "--envs", "2", "--set", "batch_rows=32",
        "--set", "replay_rows=20000", "--set", "utd_ratio=0.1", "--set", "warm_up_steps=100",
    ),
}  # fmt: skip
KINDS = (
    ("on-policy", "async"),
    ("off-policy", "async"),
    ("off-policy, large", "async"),
    ("on-policy", "lockstep"),
)
_ENDPOINT = f"tcp/{ADDRESSES[LEARNER]}:7447"
_WORKERS = 2
_HEALED_S = 60.0
_SILENT_S = 2.0  # not yet noticed


class Run:
    """Learner and actors at the ends of a link.

    Attributes:
        path: The run's directory.
    """

    def __init__(self, link: Link, commands: Commands, path: Path, *options: str) -> None:
        self.path, self._log = path, path / "segments.log"
        self._learner = commands.start(
            "learner", *options, "--n", str(_WORKERS), "--total-steps", "100000000", "--listen",
            _ENDPOINT, "--insecure", "--run-dir", str(path), "--metrics-port", "-1",
            within=link.inside(LEARNER),
        )  # fmt: skip
        self._actor = commands.start(
            "actor", "--n", str(_WORKERS), "--connect", _ENDPOINT, "--metrics-port", "-1",
            within=link.inside(ACTOR),
        )  # fmt: skip
        wait_for(lambda: rows(path / "updates.csv") >= 3, "the first updates")
        wait_for(lambda: len(self._accepted()) == _WORKERS, "segments of all workers")
        self._workers = self._pids()

    def goes_on(self) -> float:
        """Wait for updates and for segments of all workers; gives how long that took, in seconds.

        Raises:
            TimeoutError: They did not come.
        """
        updates, begin = rows(self.path / "updates.csv"), self._log.stat().st_size

        def all_at_work() -> bool:
            learned = rows(self.path / "updates.csv") > updates + 2  # the first was complete
            return learned and len(self._accepted(begin)) == _WORKERS

        return wait_for(all_at_work, "updates, and segments of all workers", _HEALED_S)

    def rate(self, seconds: float) -> float:
        """Count the steps of segments that are accepted in this time, for each second."""
        begin, begin_s = self._log.stat().st_size, time.monotonic()
        time.sleep(seconds)
        took_s = time.monotonic() - begin_s
        return sum(self._accepted(begin).values()) / took_s

    def end(self, result: Result) -> None:
        """End learner and actors; what does not hold goes into the result."""
        same = self._workers == self._pids()
        codes = [each.end(signal.SIGINT) for each in (self._learner, self._actor)]
        words = self._learner.text() + self._actor.text()
        result.add(
            "" if same else f"workers were replaced: {self._actor.text()[-300:]}",
            "" if codes == [130, 130] else f"exit codes {codes}",
            "a traceback" if "Traceback" in words else "",
            unbalanced(self.path),
            accounts_disagree(self.path),
            of="the end",
        )

    def _accepted(self, begin: int = 0) -> dict[str, int]:
        """Steps that the ledger has accepted of each actor, from this byte of it on."""
        steps: dict[str, int] = {}
        with self._log.open("rb") as file:
            file.seek(begin)
            for line in file:
                actor, _, verdict, count, *_ = line.decode().split()
                if verdict == "accepted" and line.endswith(b"\n"):
                    steps[actor] = steps.get(actor, 0) + int(count)
        return steps

    def _pids(self) -> list[int]:
        return sorted(each.pid for each in self._actor.workers())


def partitions(variant: str, cuts_s: Sequence[float], place: Path) -> Result:
    """Cut the link in all ways, for all these times."""
    result = Result(
        f"partitions, {variant}",
        f"learns again by itself with the same workers, in {_HEALED_S:.0f} s; accounts balance",
    )
    again_s = []
    with Link() as link, Commands(place) as commands:
        run = Run(link, commands, place / f"cut-{variant}", *REACH, *VARIANTS[variant])
        for name, senders in CUTS.items():
            for cut_s in cuts_s:
                of = f"{name} cut {cut_s:.0f} s"
                link.cut(*senders)
                time.sleep(cut_s)
                link.cut()
                try:
                    again_s.append(run.goes_on())
                    result.add(of=f"{of}, again after {again_s[-1]:.1f} s")
                except TimeoutError as error:
                    result.add(str(error), of=of)
        link.cut(*CUTS["both directions"])
        time.sleep(_SILENT_S)
        run.end(result)
    result.quantiles("learns again after", again_s)
    return result


def lossy(variant: str, clock: str, congestion: str, seconds: float, place: Path) -> Result:
    """Compare a link without delay or loss with one that has both."""
    result = Result(
        ", ".join(filter(None, ("lossy link", variant, clock, congestion))),
        f"goes on, accounts balance{'; at least half as fast' if clock == 'async' else ''}",
    )
    with Link(congestion=congestion) as link, Commands(place) as commands:
        path = place / f"lossy-{variant}-{clock}-{congestion}"
        run = Run(link, commands, path, *HOPPERS[variant], f"--{clock}")
        plain = run.rate(seconds)
        link.become(LOSSY)
        try:
            run.goes_on()
            found = run.rate(seconds)
            slow = clock == "async" and found < plain / 2
            result.add("less than half as fast" if slow else "", of=f"{found:.0f} of {plain:.0f}/s")
            result.figures["env steps/s"] = f"{found:.0f}; without delay and loss {plain:.0f}"
        except TimeoutError as error:
            result.add(str(error), of="delay and loss")
        link.become(Quality())
        try:
            result.add(of=f"healed, again after {run.goes_on():.1f} s")
        except TimeoutError as error:
            result.add(str(error), of="healed")
        run.end(result)
    return result


def _end(number: int, _: FrameType | None) -> None:
    """End, and let no other signal disturb that: namespaces outlive their makers."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
    sys.exit(128 + number)


def main() -> None:
    """Parse, cut, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--partition", type=float, nargs="*", default=[10.0], help="seconds of each cut"
    )
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="over each link; 0: no lossy ones"
    )
    parser.add_argument("--congestion", nargs="+", default=[""], help="of TCP, on lossy links")
    options = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _end)
    results = []
    try:
        with folder() as place:
            if options.partition:
                results += [partitions(v, options.partition, place) for v in VARIANTS]
            if options.seconds:
                ways = itertools.product(KINDS, options.congestion)
                results += [lossy(*kind, name, options.seconds, place) for kind, name in ways]
    except NoLinkError as error:
        sys.exit(f"links: {error}")
    tell(results)


if __name__ == "__main__":
    main()
