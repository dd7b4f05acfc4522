"""``a2s replay import``: transitions of elsewhere as a replay, to be prior data of a run."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from a2s.commands.configure import placed
from a2s.commands.minari_import import MinariSegments, is_data_set
from a2s.learner.replay import directory
from a2s.learner.replay.segments import StoredSegments
from a2s.protocol.errors import MalformedMessageError, UsageError


def write(source: str, output: Path, limit: int | None, env: str | None) -> dict[str, Any]:
    """Write the last ``limit`` transitions of a source as a new replay directory.

    The source is a run or replay directory, or a Minari data set: its directory, or its name. They
    are checked as a learner checks what its actors send. ``env`` is the name of the environment,
    where a run has another than the source says.

    Returns:
        ``path``, ``env``, ``obs_size``, ``action_low``, ``action_high``, ``transitions`` and
        ``source``.

    Raises:
        UsageError: There is no such source, it has nothing to learn from or something that is
            impossible to learn from, or the output is there already; nothing is left of it.
        RunDirectoryError: The source is damaged or in use, or there is no room.
    """
    if output.exists():
        raise UsageError(f"{output}: is there already; name another with -o")
    with ExitStack() as stack:
        found = _open(source, stack)
        spaces, env_id = found.about.spaces, placed(env) if env else found.about.env_id
        if not env_id:
            raise UsageError(f"{source}: does not say its environment; name it with --env")
        if not found.num_steps:
            raise UsageError(f"{source}: found no transition, expected some")
        count = min(limit or found.num_steps, found.num_steps)
        with _whole_or_not(output) as partial:
            replay = directory.create(partial, env_id, spaces, count, source=_named(source))
            with closing(replay):
                try:
                    for segment in found:
                        replay.insert(segment)
                except MalformedMessageError as error:
                    raise UsageError(f"{source}: {error}; leave it out") from None
                replay.flush()
    return {
        "path": str(output),
        "env": env_id,
        "obs_size": spaces.obs_size,
        "action_low": spaces.action_low.tolist(),
        "action_high": spaces.action_high.tolist(),
        "transitions": len(replay),
        "source": _named(source),
    }


def _named(source: str) -> str:
    """The source by a name that is as good in another working directory."""
    return str(Path(source).absolute()) if Path(source).is_dir() else source


def _open(source: str, stack: ExitStack) -> StoredSegments | MinariSegments:
    path = Path(source)
    if not path.is_dir() or is_data_set(path):
        return MinariSegments(source)
    return stack.enter_context(closing(StoredSegments(directory.find(path))))


@contextmanager
def _whole_or_not(output: Path) -> Iterator[Path]:
    """Let a directory be filled under another name, then give it its own."""
    partial = output.parent / f".{output.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)  # an import was killed here
    try:
        yield partial
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
