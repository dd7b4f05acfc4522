"""``a2s tune``: a search for hyperparameters with Optuna, each trial an `a2s train` of its own."""

import contextlib
import json
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import typer
from optuna.trial import Trial, TrialState
from sqlalchemy import URL
from sqlalchemy.exc import SQLAlchemyError

from a2s.commands.train import started
from a2s.learner.numerals import written
from a2s.learner.run.config import assemble, parse_settings, read
from a2s.learner.run.directory import CONFIG, evaluations
from a2s.learner.run.writing import write_atomically
from a2s.protocol.errors import A2SError, UsageError

_LAST = 5  # evaluations whose mean a trial is worth
_EVALUATIONS = 20  # of a trial
_FREE_TRIALS = 5  # nothing is pruned before so many are complete
_FREE_SHARE = 0.3  # of a trial, nor before that
_POLL_S = 0.5
_LOG, _RANGE, _SEARCH = ":log", "..", "search"
_ENDED = (TrialState.COMPLETE, TrialState.PRUNED)
ON_POLICY = (
    "learning_rate=1e-4..1e-3:log", "critic_learning_rate=3e-4..3e-3:log", "gamma=0.97..0.998",
    "gae_lambda=0.9..0.98", "batch_steps=1024,2048,4096", "kl_stop=0.02..0.1:log",
    "std_floor=0.1..0.4", "suggestions=4,10,16", "pull_least_share=0.85..0.98",
)  # fmt: skip
_OF_Q = ("suggestions", "pull_least_share")
OFF_POLICY = (
    "learning_rate=1e-4..1e-3:log", "tau=0.003..0.03:log", "gamma=0.97..0.998",
    "utd_ratio=0.5,1,2", "act_suggestions=1,4,10", "quantiles_to_drop=0,2,4",
)  # fmt: skip


class Range(NamedTuple):
    """What may be tried of one hyperparameter: one of some values, or a number between two."""

    name: str
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    whole: bool = False

    def suggest(self, trial: Trial) -> str:
        """Have a trial choose; gives the text for ``--set``."""
        if self.choices:
            return str(trial.suggest_categorical(self.name, self.choices))
        if self.whole:
            return str(trial.suggest_int(self.name, int(self.low), int(self.high), log=self.log))
        return f"{trial.suggest_float(self.name, self.low, self.high, log=self.log):.6g}"

    def ends(self) -> tuple[str, ...]:
        """Values that have to be possible, so that all of it is."""
        return self.choices or (f"{self.low:.6g}", f"{self.high:.6g}")


def parse_range(text: str) -> Range:
    """Read ``KEY=LOW..HIGH``, ``KEY=LOW..HIGH:log`` or ``KEY=VALUE,VALUE,...``.

    A range whose ends are written as whole numbers has whole numbers.

    Raises:
        UsageError: It is none of these.
    """
    name, equals, rest = text.partition("=")
    if not (name and equals and rest):
        raise _unreadable(text)
    body = rest.removesuffix(_LOG)
    if _RANGE not in body:
        choices = tuple(rest.split(","))
        if len(choices) == 1 or not all(choices):
            raise _unreadable(text)
        return Range(name, choices)
    ends = body.split(_RANGE)
    try:
        low, high = map(float, ends)
    except ValueError:
        raise _unreadable(text) from None
    log = rest.endswith(_LOG)
    if not -math.inf < low < high < math.inf or (log and low <= 0.0):
        raise _unreadable(text)
    return Range(name, low=low, high=high, log=log, whole=all(map(str.isdigit, ends)))


def _unreadable(text: str) -> UsageError:
    return UsageError(
        f"--space: found {text!r}, expected KEY=LOW..HIGH, KEY=LOW..HIGH:log or KEY=VALUE,VALUE"
    )


def default_space(variant: str | None, algo: str | None) -> tuple[str, ...]:
    """What is tried where the user names nothing; A2C has no suggestions."""
    if variant == "off-policy":
        return OFF_POLICY
    return tuple(r for r in ON_POLICY if algo != "a2c" or r.partition("=")[0] not in _OF_Q)


class Search(NamedTuple):
    """A search: its directory, the run that every trial makes, and what is tried.

    Attributes:
        words: The options of the run, as words of a command line.
        options: The same by name.
        settings: Hyperparameters that every trial has, ``KEY=VALUE``.
    """

    path: Path
    words: Sequence[str]
    options: Mapping[str, Any]
    settings: Sequence[str]
    space: Sequence[Range]

    def place(self, number: int) -> Path:
        """The run directory of a trial."""
        return self.path / f"trial-{number:04d}"

    def checked(self) -> tuple["Search", int]:
        """This, with whole numbers where a hyperparameter is one; and the steps of a trial.

        Raises:
            UsageError: A name occurs twice, or a value is impossible.
        """
        given = {name: value for name, value in self.options.items() if value is not None}
        fixed = parse_settings([*self.settings])
        names = [*fixed, *(each.name for each in self.space)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise UsageError(f"--space: found {min(twice)} twice, expected once; --set counts")
        made = assemble(given, fixed)
        for each in self.space:
            for end in each.ends():
                made = assemble(given, {**fixed, each.name: end})
        kinds = {each.name: each.type for each in fields(made.hyper)}
        space = [r._replace(whole=kinds[r.name] is int and not r.choices) for r in self.space]
        return self._replace(space=space), made.run.total_steps

    def identity(self) -> str:
        """What makes two searches the same."""
        return json.dumps([list(self.words), list(self.settings), [list(r) for r in self.space]])


def tune(
    search: Search, *, trials: int, parallel: int, seed: int, stop: threading.Event
) -> dict[str, Any]:
    """Make trials until there are so many in the study, those of earlier calls included.

    ``best.toml`` is the configuration of the best trial; the study is in ``study.db``. A trial is
    worth its last evaluations, and ended early where it is behind the median of the others.

    Returns:
        The JSON object of ``a2s tune --json``; empty if it was stopped before any trial's end.

    Raises:
        UsageError: A hyperparameter or an option is impossible, or there is another search.
        A2SError: A trial failed, or none came to its end.
    """
    search, total_steps = search.checked()
    study = _study(search, round(_FREE_SHARE * total_steps), seed, parallel)
    for trial in study.get_trials(states=[TrialState.RUNNING]):  # a kill left them so
        study.tell(trial.number, state=TrialState.FAIL)
    every = max(1, total_steps // _EVALUATIONS)
    left = trials - len(study.get_trials(states=_ENDED))
    if left > 0:
        words = f"{left} trials of {total_steps:,} steps, {parallel} at once, in {search.path}"
        typer.echo(f"a2s tune: {words}", err=True)
        with contextlib.suppress(_Stopped):
            study.optimize(
                lambda trial: _try(search, trial, every, stop),
                left,
                n_jobs=parallel,
                callbacks=[_say],
            )
    complete = study.get_trials(states=[TrialState.COMPLETE])
    if not complete and stop.is_set():
        return {}
    if not complete:
        raise A2SError(f"a2s tune: no trial came to its end; go on with the same -o {search.path}")
    best = study.best_trial
    options, hyper = read(search.place(best.number) / CONFIG)
    config = assemble({**options, "evaluate_every": 0}, hyper).to_toml()
    write_atomically(search.path / "best.toml", config.encode())
    ended = len(study.get_trials(states=_ENDED))
    return {
        "path": str(search.path),
        "trials": ended,
        "pruned": ended - len(complete),
        "best_trial": best.number,
        "best_value": best.value,
        "best": best.params,
        "config": str(search.path / "best.toml"),
    }


def _study(search: Search, warm_up: int, seed: int, parallel: int) -> optuna.Study:
    """Open the study of a search, or begin one.

    Raises:
        UsageError: The study there is of another search, or cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    place = search.path / "study.db"
    try:
        search.path.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            storage=URL.create("sqlite", database=str(place)).render_as_string(),
            study_name="a2s",
            direction="maximize",
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=seed, constant_liar=parallel > 1),
            pruner=optuna.pruners.MedianPruner(_FREE_TRIALS, n_warmup_steps=warm_up),
        )
        known = study.user_attrs.get(_SEARCH)
    except (OSError, SQLAlchemyError) as error:
        words = str(error).splitlines()[0]
        raise UsageError(f"--output: {place} cannot be used: {words}; name another") from None
    is_new = known is None and not any(search.path.glob("trial-*"))
    if not is_new and known != search.identity():
        raise UsageError(
            f"--output: {search.path} has another search: found {known}, expected "
            f"{search.identity()}; name another"
        )
    study.set_user_attr(_SEARCH, search.identity())
    return study


class _Stopped(Exception):  # noqa: N818  # no error: the user stops the search
    """The search is stopped; the trial counts for nothing."""


def _try(search: Search, trial: Trial, every: int, stop: threading.Event) -> float:
    """Train once, report evaluations as they come, and end what is not worth going on."""
    run = search.place(trial.number)
    words = [
        "train", *search.words, "--run-dir", str(run), "--metrics-port", "-1", "--n", "1",
        "--evaluate-every", str(every), "--episodes", "1",
    ]  # fmt: skip
    chosen = [f"{each.name}={each.suggest(trial)}" for each in search.space]
    for setting in (*search.settings, *chosen):
        words += ["--set", setting]
    log, reported = search.path / f"{run.name}.log", 0
    with log.open("w") as out, started(words, out) as train:
        while train.poll() is None:
            for row in evaluations(run, "mean")[reported:]:
                reported += 1
                trial.report(row.mean, row.env_steps)
                if trial.should_prune():
                    raise optuna.TrialPruned
            if stop.wait(_POLL_S):
                raise _Stopped
    if train.returncode:
        last = log.read_text().strip().splitlines()[-1:]
        raise A2SError(f"trial {trial.number}: {''.join(last).removeprefix('a2s: ')}")
    means = [row.mean for row in evaluations(run, "mean")][-_LAST:]
    if not means:
        raise A2SError(f"trial {trial.number}: it was not evaluated, see {run}/evaluator.log")
    return sum(means) / len(means)


def _say(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
    if trial.state not in _ENDED:
        return
    values = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in trial.params.items()}
    chosen = " ".join(f"{name}={value}" for name, value in values.items())
    value = "pruned" if trial.state == TrialState.PRUNED else written(trial.value or 0.0)
    typer.echo(f"trial {trial.number}: {value}  {chosen}", err=True)


def line(found: Mapping[str, Any]) -> str:
    """Give the result of `tune` for a reader."""
    return (
        f"{found['trials']} trials, {found['pruned']} of them ended early; the best is "
        f"{found['best_trial']}: {written(found['best_value'])}\n"
        f"again       a2s train --config {found['config']}"
    )
