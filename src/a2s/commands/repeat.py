"""``a2s learner --replay-journal``: what a run has learned, once more, without actors."""

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import typer

from a2s.actors.description import Describing
from a2s.commands.learner import Place, prepare
from a2s.learner.ingest import journal
from a2s.learner.make import make_learner
from a2s.learner.run import checkpoint, saver
from a2s.learner.run import directory as run_directory
from a2s.learner.run.config import Configuration
from a2s.learner.run.progress import make_view
from a2s.learner.run.writing import writing
from a2s.protocol.errors import A2SError, UsageError
from a2s.protocol.in_process import Exchange, InProcessBus

_JOURNAL, _CHECKPOINTS, _TENSORS = "journal", "checkpoints", "tensors.safetensors"
_TAKEN = (
    "segments.log",
    run_directory.UPDATES,
    run_directory.EPISODES,
    run_directory.EVALUATIONS,
)


def repeat(configuration: Configuration, place: Place, describing: Describing, source: Path) -> int:
    """Learn again from the oldest checkpoint whose journal is kept, and compare the weights.

    ``source`` is the directory of a run; it is not changed. That of ``place`` is empty or not
    there.

    Returns:
        The exit code: 0 if every checkpoint that both have is equal.

    Raises:
        A2SError: ``source`` has nothing to learn again from, or the weights differ.
    """
    run = replace(configuration.run, evaluate_every=0, stop_at_return=math.inf, tensorboard=False)
    configuration = replace(configuration, run=run)
    described, stop = prepare(configuration, describing, place.out)
    if described is None:
        return stop.exit_code
    with (
        run_directory.claimed(source),
        place.opened(run) as (stop, metrics, _, processes),
        closing(make_view(f"again: {source}", quiet=place.as_json)) as view,
    ):
        try:
            start = _copy(source, place.path)
            learner = make_learner(
                configuration=configuration,
                spaces=described.spaces,
                layout=described.layout,
                episode_limit=described.episode_limit,
                bus=InProcessBus(Exchange()),
                path=place.path,
                metrics=metrics,
                view=view,
                resume=True,
                mark=0,  # nobody joins it
                processes=processes,
            )
        except A2SError:
            shutil.rmtree(place.path)
            raise
        known = _tensors(source)
        place.write_config(configuration)
        summary = learner.run(stop.is_set, only_again=True)
    found = _tensors(place.path)
    both = sorted((known.keys() & found.keys()) - {start})
    unequal = [name for name in both if known[name] != found[name]]
    if unequal:
        raise A2SError(
            f"{place.path}: checkpoint {unequal[0]} differs from that of {source}; was it made "
            "with other settings, another release, or another processor?"
        )
    compared = f"equal: checkpoints {', '.join(both)}" if both else (
        f"nothing compared: there is no checkpoint after {start}, with which it began"
    )  # fmt: skip
    typer.echo(f"{summary['updates']:,} updates in {place.path}, {compared}", place.out)
    if place.as_json:
        typer.echo(json.dumps(summary | {"equal": both}))
    return stop.exit_code


def _copy(source: Path, path: Path) -> str:
    """Copy what a learner needs that goes on from the oldest checkpoint; gives its name."""
    folder = source / _JOURNAL
    goes_on = (
        (each, state)
        for each, state in _whole(source / _CHECKPOINTS)
        if state["journal"] is not None and journal.has(folder, saver.place(state))
    )
    each, state = next(goes_on, (None, {}))
    if each is None:
        raise UsageError(
            f"--replay-journal: {source} has no checkpoint whose journal is there; name another run"
        )
    if saver.has_replay(state) and not (source / "replay").exists():
        raise UsageError(
            f"--replay-journal: {source / 'replay'} is not there any more; restore it, or name "
            "another run"
        )
    with writing(path):
        shutil.copytree(each, path / _CHECKPOINTS / each.name)
        shutil.copytree(folder, path / _JOURNAL)
        for name in _TAKEN:
            if (source / name).exists():
                shutil.copy(source / name, path / name)
        if (source / "replay").exists():
            shutil.copytree(source / "replay", path / "replay")
    return each.name


def _whole(folder: Path) -> Iterator[tuple[Path, checkpoint.State]]:
    """The checkpoints that are as they were written, with their states, the oldest first."""
    for each in checkpoint.all_of(folder):
        with suppress(checkpoint.DamagedError):
            yield each, checkpoint.read(each)[1]


def _tensors(path: Path) -> dict[str, str]:
    """The checksums of the tensors of the whole checkpoints, by their names."""
    found = {}
    for each, _ in _whole(path / _CHECKPOINTS):
        lines = (each / "SHA256SUMS").read_text().splitlines()
        found[each.name] = next(line for line in lines if line.endswith(_TENSORS))
    return found
