"""``a2s doctor RUN``: whether a run can be gone on with, without loss."""

from collections.abc import Callable, Iterator
from pathlib import Path

from a2s.commands.doctor import Finding
from a2s.learner.ingest import journal
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.replay import directory as replay
from a2s.learner.replay import files
from a2s.learner.run import checkpoint, saver, table_mark
from a2s.learner.run.choice import require_config
from a2s.learner.run.directory import claimed
from a2s.protocol.errors import RunDirectoryError


def examine_run(path: Path) -> Iterator[Finding]:
    """Verify the checksums of everything that ``--resume`` reads.

    Raises:
        UsageError: It is not the directory of a run.
        RunDirectoryError: A learner is at work there.
    """
    require_config(path)
    taken = "a learner is at work there; its files are looked at when it has stopped"
    with claimed(path, f"{taken}; a2s status {path} shows it now"):
        findings, whole = _checkpoints(path / "checkpoints")
        yield from findings
        newest = whole[-1] if whole else None
        has_replay = any(map(saver.has_replay, whole))
        ledger, accepted_steps = _ledger(path, newest, has_replay=has_replay)
        yield ledger
        for name in table_mark.changed(path, newest["tables"] if newest else {}):
            yield Finding(name, "note", table_mark.CHANGED, table_mark.REMEDY)
        places = [saver.place(state) for state in whole if state["journal"] is not None]
        if places:
            yield _journal(path / "journal", places, accepted_steps)
        if (path / "replay" / files.NAME).exists() or has_replay:
            yield _finding("replay", lambda: _replay(path / "replay"))


def _finding(name: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(name, "ok", look())
    except RunDirectoryError as error:
        return _failed(name, error)


def _failed(name: str, error: RunDirectoryError) -> Finding:
    what, _, remedy = str(error).partition("; ")
    return Finding(name, "fail", what, remedy)


def _checkpoints(folder: Path) -> tuple[list[Finding], list[checkpoint.State]]:
    """Look at all, the newest last; gives the states of the whole ones."""
    findings, whole = list[Finding](), list[checkpoint.State]()
    for each in checkpoint.all_of(folder):
        name = f"checkpoint {each.name}"
        try:
            _, state = checkpoint.read(each)
        except checkpoint.DamagedError as error:
            remedy = "nothing: --resume uses the one before" if whole else "restore it from a copy"
            findings.append(Finding(name, "note", str(error), remedy))
        else:
            findings.append(Finding(name, "ok", f"{state.get('env_steps', 0):,} steps"))
            whole.append(state)
    if not whole:
        remedy = "restore one from a copy, or begin another run"
        findings.append(Finding("checkpoints", "fail", "none is whole", remedy))
    return findings, whole


def _ledger(
    path: Path, newest: checkpoint.State | None, *, has_replay: bool
) -> tuple[Finding, int]:
    """Look at the ledger; gives its accepted steps."""
    known = None if newest is None else saver.ledger_mark(newest)
    try:
        ledger = Ledger(path / "segments.log", known)
    except RunDirectoryError as error:
        return _failed("ledger", error), 0
    try:
        accepted, steps = ledger.accounts().accepted, ledger.accepted_steps
    finally:
        ledger.close()
    if newest is None or known is None or steps >= known.accepted_steps:
        return Finding("ledger", "ok", f"{accepted:,} segments accepted, {steps:,} steps"), steps
    place = saver.place(newest)
    found = f"{path / 'segments.log'}: {steps:,} steps, the checkpoint knows "
    found += f"{known.accepted_steps:,}"
    if steps >= place.accepted_steps and journal.has(path / "journal", place):
        return Finding("ledger", "ok", f"{found}; journal/ has the others"), steps
    if has_replay:
        return Finding("ledger", "fail", found, "restore it from a copy: --resume refuses"), steps
    remedy = "restore it from a copy; else --resume goes on, and the accounts lack what is gone"
    return Finding("ledger", "note", found, remedy), steps


def _journal(folder: Path, places: list[journal.Place], accepted_steps: int) -> Finding:
    """Read all that one of the whole checkpoints needs, the newest last."""
    if not journal.has(folder, places[-1]):
        found, _, lost = journal.without(places[-1], accepted_steps).partition("; ")
        return Finding("journal", "note", f"{folder} {found}", f"--resume goes on: {lost}")
    return _finding("journal", lambda: _again(folder, places, accepted_steps))


def _again(folder: Path, places: list[journal.Place], accepted_steps: int) -> str:
    records, _ = journal.read(folder, places[-1])
    kept = places[-1].accepted_steps + journal.num_steps(records)
    journal.require_all(folder, accepted_steps - kept)
    again = sum(isinstance(record, journal.Taken) for record in records)
    oldest = next(each for each in places if journal.has(folder, each))
    if oldest != places[-1]:
        journal.read(folder, oldest)
    return f"{again} batches since the newest whole checkpoint, learned again by --resume"


def _replay(path: Path) -> str:
    if not (path / files.NAME).exists():
        raise RunDirectoryError(f"{path} is not there any more; restore it: --resume refuses")
    found = replay.look_at(path, alone=True)
    found.close()
    torn = f", {found.torn_records} torn records at its end" if found.torn_records else ""
    return f"{len(found):,} transitions{torn}"
