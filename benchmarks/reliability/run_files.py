"""What the files of a run say: what was learned, and whether the accounts agree."""

import csv
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from a2s.commands.doctor_run import examine_run
from a2s.learner.ingest import journal
from a2s.learner.run import checkpoint, saver
from a2s.protocol.errors import A2SError


@dataclass(frozen=True)
class Learned:
    """What two runs that learned the same have alike."""

    weights: str
    accepted: int
    steps: int
    updates: list[dict[str, str]]
    episodes: list[dict[str, str]]

    def difference(self, other: "Learned") -> str:
        """Name what differs; empty: nothing."""
        return ", ".join(k for k, v in vars(self).items() if v != getattr(other, k))


def learned(path: Path) -> Learned:
    """Read a run that has ended."""
    summary = read_summary(path)
    return Learned(
        weights=summary["weights_sha256"],
        accepted=summary["segments"]["accepted"],
        steps=summary["env_steps"],
        updates=list(table(path / "updates.csv")),
        episodes=list(table(path / "episodes.csv")),
    )


def table(path: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of a table without their times."""
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            yield {k: v for k, v in row.items() if k != "wall_s"}


def read_summary(path: Path) -> dict[str, Any]:
    """Read ``summary.json``."""
    found: dict[str, Any] = json.loads((path / "summary.json").read_text())
    return found


def answered(path: Path) -> list[tuple[str, int, str, int]]:
    """Read the ledger: actor, number, verdict, steps of every whole line."""
    lines = (path / "segments.log").read_bytes().splitlines(keepends=True)
    whole = [line.decode().split(" ") for line in lines if line.endswith(b"\n")]
    return [(actor, int(seq), verdict, int(steps)) for actor, seq, verdict, steps, *_ in whole]


def accounts_disagree(path: Path) -> str:
    """Look for a segment that was acknowledged and is lost, or counts twice; empty: none.

    All that the ledger has accepted was learned from before the newest checkpoint, or is in the
    journal after it. No learner is at work there.
    """
    lines = answered(path)
    twice = [key for key, n in Counter((actor, seq) for actor, seq, *_ in lines).items() if n > 1]
    if twice:
        return f"{len(twice)} segments are twice in the ledger, first {twice[0]}"
    _, state = checkpoint.load(path / "checkpoints")
    place = saver.place(state)
    records, _ = journal.read(path / "journal", place)
    stored = [record for record in records if isinstance(record, journal.Stored)]
    keys = Counter((segment.actor, segment.seq) for _, segment in stored)
    if keys and max(keys.values()) > 1:
        return "a segment is twice in the journal"
    accepted = {(actor, seq) for actor, seq, verdict, _ in lines if verdict == "accepted"}
    known = sum(
        segment.num_steps for _, segment in stored if (segment.actor, segment.seq) in accepted
    )
    counted = sum(steps for *_, verdict, steps in lines if verdict == "accepted")
    if counted != place.accepted_steps + known:
        return f"{counted} steps accepted, {place.accepted_steps} + {known} kept"
    return ""


def unbalanced(path: Path) -> str:
    """Say how the accounts of a run that has ended do not balance; empty: they do."""
    segments = read_summary(path)["segments"]
    parts = sum(segments[name] for name in ("accepted", "stale", "refused", "lost"))
    return "" if segments["sent"] == parts else f"sent is not the sum of its parts: {segments}"


def not_whole(path: Path) -> str:
    """Say what `a2s doctor` finds wrong with a run; empty: nothing, or no run was begun."""
    if not (path / "config.toml").exists():
        left = sorted(each.name for each in path.iterdir()) if path.exists() else []
        return f"no run was begun, but {', '.join(left)} is left" if left else ""
    try:
        findings = list(examine_run(path))
    except A2SError as error:
        return str(error)
    return "; ".join(f"{f.name}: {f.found}" for f in findings if f.state != "ok")
