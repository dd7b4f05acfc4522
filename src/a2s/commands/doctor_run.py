"""``a2s doctor RUN``: whether a run can be gone on with, without loss."""

from collections.abc import Callable, Iterator
from pathlib import Path

from a2s.commands.doctor import Finding
from a2s.learner.ingest import journal
from a2s.learner.ingest.ledger import Ledger, Mark
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
    with claimed(path):
        whole = []
        for each in checkpoint.all_of(path / "checkpoints"):
            finding, state = _checkpoint(each)
            yield finding
            if state is not None:
                whole.append(state)
        if not whole:
            yield Finding("checkpoints", "fail", "none is whole", "restore one from a copy")
        known = saver.ledger_mark(whole[-1]) if whole else None
        yield _finding("ledger", lambda: _ledger(path, known))
        for name in table_mark.changed(path, whole[-1]["tables"] if whole else {}):
            yield Finding(name, "note", table_mark.CHANGED, table_mark.REMEDY)
        places = [saver.place(state) for state in whole if state["journal"] is not None]
        if places:
            yield _finding("journal", lambda: _journal(path / "journal", places))
        if (path / "replay" / files.NAME).exists() or any(map(saver.has_replay, whole)):
            yield _finding("replay", lambda: _replay(path / "replay"))


def _finding(name: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(name, "ok", look())
    except RunDirectoryError as error:
        what, _, remedy = str(error).partition("; ")
        return Finding(name, "fail", what, remedy)


def _checkpoint(path: Path) -> tuple[Finding, checkpoint.State | None]:
    name = f"checkpoint {path.name}"
    try:
        _, state = checkpoint.read(path)
    except checkpoint.DamagedError as error:
        return Finding(name, "note", str(error), "nothing: --resume uses the one before"), None
    return Finding(name, "ok", f"{state.get('env_steps', 0):,} steps"), state


def _ledger(path: Path, known: Mark | None) -> str:
    ledger = Ledger(path / "segments.log", known)
    try:
        accounts = ledger.accounts()
    finally:
        ledger.close()
    return f"{accounts.accepted:,} segments accepted, {ledger.accepted_steps:,} steps"


def _journal(folder: Path, places: list[journal.Place]) -> str:
    """Read all that one of the whole checkpoints needs, the newest last."""
    if not journal.has(folder, places[-1]):
        raise RunDirectoryError(
            f"{folder}: does not go on from the checkpoint; restore it, or lose what came after"
        )
    records, _ = journal.read(folder, next(each for each in places if journal.has(folder, each)))
    ends = [record.end for record in records if isinstance(record, journal.Taken)]
    again = sum(end > places[-1] for end in ends)
    return f"{again} batches since the newest whole checkpoint, learned again by --resume"


def _replay(path: Path) -> str:
    if not (path / files.NAME).exists():
        raise RunDirectoryError(f"{path} is not there any more; restore it: --resume refuses")
    found = replay.look_at(path, alone=True)
    found.close()
    torn = f", {found.torn_records} torn records at its end" if found.torn_records else ""
    return f"{len(found):,} transitions{torn}"
