"""``a2s evaluate``: fresh episodes with the policy of a run, or with a policy file."""

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from a2s.actors.evaluation import evaluate, read_policy, trained_on
from a2s.actors.policy import mode_of
from a2s.actors.suggester import Mode
from a2s.commands.configure import environment_of
from a2s.commands.process import pass_on
from a2s.learner.numerals import written
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import UsageError, nearest

_WEIGHTS = ("latest", "best")
_ENVS = 8


def evaluate_run(
    run: Path,
    options: Mapping[str, Any],
    *,
    episodes: int,
    mode: str,
    weights: str,
    seed: int,
    fallback: Mapping[str, Any] = MappingProxyType({}),
    proceed: Callable[[], bool] = lambda: True,
) -> dict[str, Any]:
    """Evaluate a run directory or a policy file.

    ``options`` of the environment replace the run's, as `environment_of` takes them; those of
    ``fallback`` count only where the policy does not say its environment. ``weights`` of a run are
    ``latest`` or ``best``. The evaluation ends when ``proceed`` returns false.

    Returns:
        The JSON object of ``a2s evaluate --json``; empty when it was ended.

    Raises:
        UsageError: There is no policy, or it does not fit the environment.
        FaultyEnvironmentError: The environment raised, hung, or returned something invalid.
    """
    known, path, config = choose(run, options, fallback, mode, weights)
    result = evaluate(
        path.absolute(),
        known,
        config,
        episodes=episodes,
        num_envs=_num_envs(run),
        seed=seed,
        on_words=pass_on,
        proceed=proceed,
    )
    if result is None:
        return {}
    return {
        "env": config.env_id,
        "mode": mode,
        "weights": weights if run.is_dir() else str(path),
        "episodes": episodes,
        "mean": result.mean,
        "std": result.std,
        "returns": list(result.returns),
        "lengths": list(result.lengths),
        "info_metrics": result.metrics,
        "unusable_steps": result.unusable_steps,
    }


def policy_of(run: Path, weights: str) -> Path:
    """The file of a policy: itself, or the ``latest`` or ``best`` one of a run directory.

    Raises:
        UsageError: There is nothing else to choose.
    """
    if weights not in _WEIGHTS:
        raise UsageError(f"--weights: found {weights!r}{nearest(weights, _WEIGHTS)}")
    return run / weights / "policy.onnx" if run.is_dir() else run


class Choice(NamedTuple):
    """What is played: how, which policy, and in which environment."""

    mode: Mode
    policy: Path
    config: EnvConfig


def choose(
    run: Path, options: Mapping[str, Any], fallback: Mapping[str, Any], mode: str, weights: str
) -> Choice:
    """Decide it as `evaluate_run` is asked to.

    Raises:
        UsageError: There is no policy, or it does not say its environment.
    """
    known, path = mode_of(mode), policy_of(run, weights)
    told = trained_on(str(path), read_policy(path, known).metadata)
    given = {**fallback, **options} if told is None else options
    return Choice(known, path, environment_of(given, told))


def line(result: dict[str, Any]) -> str:
    """Give the result of `evaluate_run` in one line."""
    values = (result["mean"], result["std"], min(result["returns"]), max(result["returns"]))
    mean, std, low, high = map(written, values)
    told = "".join(f", {name} {value:.3g}" for name, value in result["info_metrics"].items())
    if unusable := result["unusable_steps"]:
        told += f"; {unusable:,} steps had numbers that could not be used"
    return (
        f"{result['env']}: {mean} +- {std} over {result['episodes']} episodes "
        f"({result['mode']}); from {low} to {high}{told}"
    )


def _num_envs(run: Path) -> int:
    """Environments in each process of the run; the default, where it is not known."""
    try:
        return max(1, int(tomllib.loads((run / "config.toml").read_text())["run"]["envs"]))
    except (OSError, tomllib.TOMLDecodeError, KeyError, ValueError, TypeError):
        return _ENVS
