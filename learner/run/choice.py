"""Which directory a run is kept in: never one in which another has been, and none for nothing."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from a2s.learner.run.directory import CONFIG, LOCK
from a2s.protocol.errors import UsageError

_LEDGER, _JOURNAL, _REPLAY = "segments.log", "journal", "replay"
_EMPTY = (LOCK, _LEDGER, f"{_JOURNAL}/00000000")


def choose(root: Path, run: str, run_dir: Path | None, *, resume: bool) -> Path:
    """Decide where a run is kept.

    Returns:
        ``run_dir`` if the user names one; else the newest ``root/run*`` to resume, or the first
        that is free of ``root/run``, ``root/run-2``, ``root/run-3``...

    Raises:
        UsageError: There is nothing to resume, the directory is in use, or it has lost its
            configuration.
    """
    if run_dir is None:
        numbered = [root / run] + [root / f"{run}-{i}" for i in range(2, 10_000)]
        if not resume:
            return next(d for d in numbered if not d.exists())
        begun = [d for d in numbered if d.exists() and ((d / CONFIG).exists() or _learned_in(d))]
        if not begun:
            raise UsageError(f"--resume: found no run {run!r} in {root}; start without --resume")
        require_config(begun[-1], "--resume: ")
        return begun[-1]
    if resume:
        require_config(run_dir, "--resume: ")
    elif (run_dir / CONFIG).exists():
        raise UsageError(f"--run-dir: {run_dir} holds a run; add --resume, or name another")
    elif _learned_in(run_dir):
        require_config(run_dir, "--run-dir: ")
    return run_dir


@contextmanager
def made(root: Path, run: str) -> Iterator[Path]:
    """Make the first directory that is free: of runs that begin at once, each has its own.

    In the end it is removed, if nothing but traces of a refused start is in it.
    """
    is_new = not root.exists()
    path = _first_made(root, run)
    try:
        yield path
    finally:
        remove_traces(path)
        if is_new:
            with suppress(OSError):  # it is not empty
                root.rmdir()


def _first_made(root: Path, run: str) -> Path:
    while True:
        path = choose(root, run, None, resume=False)
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            if path.exists():
                continue  # another run was quicker
        except OSError:
            pass  # said by whoever claims it
        return path


def require_config(path: Path, subject: str = "") -> None:
    """Require that a directory is that of a run, by its configuration.

    Raises:
        UsageError: It has none; if a run has been there the words say how it can be gone on with.
    """
    if (path / CONFIG).exists():
        return
    if learned := _learned_in(path):
        raise UsageError(
            f"{subject}{path} holds {learned}, but no {CONFIG}; restore {CONFIG} from a copy, or "
            "name another directory"
        )
    raise UsageError(f"{subject}{path} holds no {CONFIG}; name a run directory")


def remove_traces(path: Path, *logs: str) -> None:
    """Remove a directory that would be mistaken for a run, if all in it is of a refused start.

    That leaves empty files, a replay without a row, and ``logs``. If anything else is there,
    nothing is touched.
    """
    if path.is_symlink() or not path.is_dir():
        return
    inside = [each for folder in (_JOURNAL, _REPLAY) for each in (path / folder).glob("*")]
    found = [*inside, *path.iterdir()]  # files before their folder
    if all(_is_trace(each, str(each.relative_to(path)), logs) for each in found):
        for each in found:
            each.rmdir() if each.is_dir() else each.unlink()
        path.rmdir()


def _is_trace(path: Path, name: str, logs: Sequence[str]) -> bool:
    if name in (_JOURNAL, _REPLAY):
        return path.is_dir() and not path.is_symlink()
    if name.startswith(f"{_REPLAY}/"):
        is_ours = path.name == LOCK or path.suffix in (".f32", ".json", ".log")
        return is_ours and path.is_file() and _has_no_row(path.parent)
    is_empty = path.is_file() and not path.stat().st_size
    return (name in logs and path.is_file()) or (name in _EMPTY and is_empty)


def _has_no_row(replay: Path) -> bool:
    indexes = list(replay.glob("index-*.log"))
    return bool(indexes) and not any(each.stat().st_size for each in indexes)


def _learned_in(path: Path) -> str:
    """What a run has left that a new one would go on with as its own; empty: nothing."""
    ledger, folder = path / _LEDGER, path / "checkpoints"
    if ledger.is_file() and (size := ledger.stat().st_size):
        return f"a {_LEDGER} of {size:,} bytes"
    # The first one is written before the configuration: a kill may have come between.
    later = [each.name for each in folder.glob("[0-9]*") if not each.name.startswith("00000000")]
    return f"checkpoint {max(later)}" if later else ""
