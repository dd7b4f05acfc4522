"""kill -9 of the learner: a third inside a checkpoint, a third inside an ingest, a third anywhere.

``python -m reliability.kills --scripted 100 --real 100``. Scripted actors send the same segments
whatever happens, so that weights, tables and accounts must equal those of a run without kills. Real
ones are processes of ``a2s actor``; each kill is followed by ``a2s learner --resume``.
"""

import argparse
import random
import time
from functools import partial
from pathlib import Path

from reliability.commands import Commands, rows, wait_for
from reliability.faults import Fault, Faults
from reliability.run_files import accounts_disagree, answered, unbalanced
from reliability.scripted import ScriptedRun
from reliability.trial import Result, folder, tell
from scripted_actors import WAYS
from system_helpers import FAST, OFF_POLICY, REACH, Command, metrics_port, scrape

CHECKPOINT, INGEST = ("/checkpoints/.",), ("/journal/", "/segments.log", "/replay/index")
PLACES = {"checkpoint": CHECKPOINT, "ingest": INGEST, "anywhere": ("",)}
NAMES = tuple(PLACES)
_PATIENCE_S = 120.0
VARIANTS = {
    "on-policy": FAST,
    "off-policy": (*OFF_POLICY, "--set", "warm_up_steps=100"),
}


def scripted(kills: int, seed: int, faults: Faults, notes: Path) -> Result:
    """Kill learners of scripted actors, up to three times in a run."""
    result = Result(
        "kill -9 of the learner, scripted actors",
        "weights, tables and accounts equal those of an undisturbed run, to the bit",
    )
    rng, wanted, done = random.Random(seed), {}, 0
    while done < kills:
        way = list(WAYS)[result.count % len(WAYS)]
        run = ScriptedRun(way, faults.place / "run", notes)
        if way not in wanted:
            faults.forget()
            faults.arm(Fault.NOTHING)
            ended = run.start()
            assert ended.code == 0, ended.words
            wanted[way] = run.learned(), faults.writes()
            run = ScriptedRun(way, faults.place / "run", notes)
        undisturbed, writes = wanted[way]
        told: list[str] = []
        wrong = ""
        for _ in range(rng.randint(1, 3)):
            name = NAMES[done % len(NAMES)]
            match = rng.choice([m for m in PLACES[name] if any(m in w for w in writes)])
            at = rng.randint(1, sum(match in write for write in writes))
            faults.arm(Fault.KILL, at, match)
            ended = run.start()
            told.append(f"{name} {match}@{at}")
            if ended.code == 0:
                break
            done += 1
            wrong = wrong or ended.defect
        faults.arm(Fault.NOTHING)
        ended = run.start()
        if wrong or ended.code:
            result.add(wrong or ended.defect, of=f"{way}, killed at {told}")
            continue
        difference = undisturbed.difference(run.learned())
        lost = run.learned().accepted - run.acknowledged()
        result.add(
            f"{difference} differ" if difference else "",
            f"{lost} more accepted than acknowledged" if lost else "",
            unbalanced(run.path),
            of=f"{way}, killed at {told}",
        )
    result.figures["kills"] = str(done)
    return result


def real(variant: str, kills: int, seed: int, faults: Faults) -> Result:
    """Kill a learner for which two real actors play; it is resumed at once."""
    result = Result(
        f"kill -9 of the learner, {variant}, real actors",
        "acknowledged and lost 0, twice 0, learns again, accounts balance; p95 below 8 s",
    )
    rng, path = random.Random(seed), faults.place / f"real-{variant}"
    config = faults.place.parent / "config.toml"
    config.write_text(f"[run]\ncheckpoint_every_updates = {5 if variant == 'on-policy' else 100}\n")
    again_s: list[float] = []
    with Commands(faults.place.parent) as commands:
        options = ("--listen", commands.endpoint, "--run-dir", str(path), "--metrics-port", "-1")
        faults.arm(Fault.NOTHING)
        learner = commands.start(
            "learner", *REACH, *VARIANTS[variant], "--config", str(config), "--n", "2",
            "--total-steps", "100000000", *options, environ=faults.environ(),
        )  # fmt: skip
        actor = commands.start(
            "actor", "--n", "2", "--connect", commands.endpoint, "--metrics-port", "0"
        )
        table = path / "updates.csv"
        wait_for(lambda: rows(table) >= 3, "the first updates")
        for number in range(kills):
            name = NAMES[number % len(NAMES)]
            match, at = rng.choice(PLACES[name][: 3 if variant == "off-policy" else 2]), 0
            at = rng.randint(1, 14 if name == "checkpoint" else 60)
            faults.arm(Fault.KILL, at, match)
            learner.process.wait(_PATIENCE_S)
            faults.arm(Fault.NOTHING)
            begin_s, before, counted = time.monotonic(), rows(table), len(answered(path))
            told = _told(actor)
            wrong = accounts_disagree(path)
            accepted = sum(verdict == "accepted" for *_, verdict, _ in answered(path))
            lost = f"{told} told, {accepted} accepted" if told > accepted else ""
            learner = commands.start("learner", "--resume", *options, environ=faults.environ())
            try:
                wait_for(partial(_goes_on, path, before, counted), "learning", _PATIENCE_S)
            except TimeoutError as error:
                result.add(wrong, lost, str(error), learner.text()[-300:], of=f"{match}@{at}")
                return result
            again_s.append(time.monotonic() - begin_s)
            trace = "a traceback" if "Traceback" in learner.text() else ""
            result.add(wrong, lost, trace, of=f"{name} {match}@{at}")
        code = learner.end(2)
        result.add("" if code == 130 else f"exit code {code}", unbalanced(path), of="the end")
        result.add(accounts_disagree(path), of="what was kept")
    result.quantiles("learns again after", again_s)
    return result


def _goes_on(path: Path, updates: int, segments: int) -> bool:
    return rows(path / "updates.csv") > updates and len(answered(path)) > segments


def _told(actor: Command) -> int:
    """Segments that living actors were told are accepted."""
    seen = scrape(metrics_port(actor))
    return int(sum(v for k, v in seen.items() if "acks_total" in k and '"accepted"' in k))


def main() -> None:
    """Parse, kill, tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scripted", type=int, default=6, help="kills")
    parser.add_argument("--real", type=int, default=3, help="kills, of each variant")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with folder() as place:
        faults = Faults(place)
        faults.enter("reliability.kills", logged=True)
        results = []
        if options.scripted:
            results.append(scripted(options.scripted, options.seed, faults, place / "notes"))
        if options.real:
            results += [real(v, options.real, options.seed, faults) for v in VARIANTS]
    tell(results)


if __name__ == "__main__":
    main()
