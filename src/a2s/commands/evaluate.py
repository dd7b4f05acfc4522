"""``a2s evaluate``: fresh episodes with the policy of a run, or with a policy file."""

import tomllib
from pathlib import Path
from typing import Any, get_args

from a2s.actors.evaluation import evaluate, read_policy
from a2s.actors.suggester import Mode
from a2s.protocol.errors import UsageError, nearest

_WEIGHTS = ("latest", "best")


def evaluate_run(
    run: Path, env: str | None, *, episodes: int, mode: str, weights: str, seed: int
) -> dict[str, Any]:
    """Evaluate a run directory or a policy file.

    Returns:
        The JSON object of ``a2s evaluate --json``.

    Raises:
        UsageError: There is no policy, or it does not fit the environment.
    """
    if weights not in _WEIGHTS:
        raise UsageError(f"--weights: found {weights!r}{nearest(weights, _WEIGHTS)}")
    known: Mode | None = next((m for m in get_args(Mode) if m == mode), None)
    if known is None:
        raise UsageError(f"--mode: found {mode!r}{nearest(mode, get_args(Mode))}")
    path = run / weights / "policy.onnx" if run.is_dir() else run
    policy = read_policy(path, known)
    env_id = env or (_env_of(run) if run.is_dir() else policy.metadata.get("env"))
    if not env_id:
        raise UsageError(f"{path}: does not say its environment; name it with --env")
    result = evaluate(policy, env_id, episodes, seed)
    return {
        "env": env_id,
        "mode": mode,
        "weights": weights if run.is_dir() else str(path),
        "episodes": episodes,
        "mean": result.mean,
        "std": result.std,
        "returns": list(result.returns),
        "lengths": list(result.lengths),
    }


def _env_of(run: Path) -> str:
    try:
        return str(tomllib.loads((run / "config.toml").read_text())["run"]["env"])
    except (OSError, tomllib.TOMLDecodeError, KeyError):
        raise UsageError(f"{run}: is not a run directory, it has no usable config.toml") from None
