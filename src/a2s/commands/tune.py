"""``a2s tune``: a search for hyperparameters with Optuna, each trial an `a2s train` of its own."""

import contextlib
import shutil
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import typer
from optuna.trial import Trial, TrialState

from a2s.commands.train import PROGRAM
from a2s.learner.numerals import written
from a2s.learner.run.config import assemble, parse_settings
from a2s.learner.run.directory import CONFIG, evaluations
from a2s.protocol.errors import A2SError, UsageError

_LAST = 5  # evaluations whose mean a trial is worth
_EVALUATIONS = 20  # of a trial
_FREE_TRIALS = 5  # nothing is pruned before so many are complete
_FREE_SHARE = 0.3  # of a trial, nor before that
_POLL_S = 0.5
_STOP_S = 30.0
_LOG, _RANGE = ":log", ".."
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

    def first(self) -> str:
        """One value that is in it."""
        return self.choices[0] if self.choices else f"{self.low:.6g}"


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
        return Range(name, tuple(rest.split(",")))
    ends = body.split(_RANGE)
    try:
        low, high = map(float, ends)
    except ValueError:
        raise _unreadable(text) from None
    log = rest.endswith(_LOG)
    if not low < high or (log and low <= 0.0):
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

    def total_steps(self) -> int:
        """Steps of a trial; the first values of the space are tried on the configuration.

        Raises:
            UsageError: Something is impossible.
        """
        given = {name: value for name, value in self.options.items() if value is not None}
        first = {each.name: each.first() for each in self.space}
        return assemble(given, {**parse_settings([*self.settings]), **first}).run.total_steps


def tune(
    search: Search, *, trials: int, parallel: int, seed: int, stop: threading.Event
) -> dict[str, Any]:
    """Make trials until there are so many in the study, those of earlier calls included.

    ``best.toml`` is the configuration of the best trial; the study is in ``study.db``. A trial is
    worth its last evaluations, and ended early where it is behind the median of the others.

    Returns:
        The JSON object of ``a2s tune --json``.

    Raises:
        UsageError: A hyperparameter or an option is impossible.
        A2SError: A trial failed, or none came to its end.
    """
    total_steps = search.total_steps()
    search.path.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warm_up = round(_FREE_SHARE * total_steps)
    study = optuna.create_study(
        storage=f"sqlite:///{search.path / 'study.db'}",
        study_name="a2s",
        direction="maximize",
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(seed=seed, constant_liar=parallel > 1),
        pruner=optuna.pruners.MedianPruner(_FREE_TRIALS, n_warmup_steps=warm_up),
    )
    for trial in study.get_trials(states=[TrialState.RUNNING]):  # a kill left them so
        study.tell(trial.number, state=TrialState.FAIL)
    every = max(1, total_steps // _EVALUATIONS)
    left = trials - len(study.get_trials(states=_ENDED))
    if left > 0:
        with contextlib.suppress(_Stopped):
            study.optimize(
                lambda trial: _try(search, trial, every, stop),
                left,
                n_jobs=parallel,
                callbacks=[_say],
            )
    complete = study.get_trials(states=[TrialState.COMPLETE])
    if not complete:
        raise A2SError(f"a2s tune: no trial came to its end; go on with the same -o {search.path}")
    best = study.best_trial
    shutil.copyfile(search.place(best.number) / CONFIG, search.path / "best.toml")
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
    with log.open("w") as out:
        train = subprocess.Popen([*PROGRAM, *words], stdout=out, stderr=subprocess.STDOUT)
        try:
            while train.poll() is None:
                for row in evaluations(run, "mean")[reported:]:
                    reported += 1
                    trial.report(row.mean, row.env_steps)
                    if trial.should_prune():
                        raise optuna.TrialPruned
                if stop.wait(_POLL_S):
                    raise _Stopped
        finally:
            _end(train)
    if train.returncode:
        last = log.read_text().strip().splitlines()[-1:]
        raise A2SError(f"trial {trial.number}: {''.join(last).removeprefix('a2s: ')}")
    means = [row.mean for row in evaluations(run, "mean")][-_LAST:]
    return sum(means) / len(means)


def _end(train: subprocess.Popen[bytes]) -> None:
    train.terminate()
    try:
        train.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        train.kill()
        train.wait()


def _say(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
    if trial.state not in _ENDED:
        return
    chosen = " ".join(f"{name}={value}" for name, value in trial.params.items())
    value = "pruned" if trial.state == TrialState.PRUNED else written(trial.value or 0.0)
    typer.echo(f"trial {trial.number}: {value}  {chosen}", err=True)


def line(found: Mapping[str, Any]) -> str:
    """Give the result of `tune` for a reader."""
    return (
        f"{found['trials']} trials, {found['pruned']} of them ended early; the best is "
        f"{found['best_trial']}: {written(found['best_value'])}\n"
        f"again       a2s train --config {found['config']}"
    )
