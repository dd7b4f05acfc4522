"""``a2s record``: a video of the policy of a run, also without a screen."""

import importlib.util
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from a2s.actors.recording import record
from a2s.commands.evaluate import choose
from a2s.commands.process import pass_on
from a2s.commands.rendering import HELP, find_backend
from a2s.learner.numerals import written
from a2s.protocol.errors import FaultyEnvironmentError, UsageError

_NEEDED = ("imageio_ffmpeg", "PIL")
_SUFFIX = ".mp4"


def record_run(
    run: Path,
    options: Mapping[str, Any],
    *,
    output: Path,
    episodes: int,
    mode: str,
    weights: str,
    seed: int,
    overlay: bool,
    fallback: Mapping[str, Any] = MappingProxyType({}),
    proceed: Callable[[], bool] = lambda: True,
) -> dict[str, Any]:
    """Record a run directory or a policy file; the arguments are those of `evaluate_run`.

    Returns:
        The JSON object of ``a2s record --json``; empty when it was ended.

    Raises:
        UsageError: There is no policy, nothing draws here, or the file cannot be written.
        FaultyEnvironmentError: The environment raised, hung, or returned something invalid.
    """
    missing = [module for module in _NEEDED if importlib.util.find_spec(module) is None]
    if missing:
        raise UsageError(f"a2s record needs {', '.join(missing)}; pip install 'a2s[video]'")
    if output.suffix != _SUFFIX:
        raise UsageError(f"--output: found {output}, expected a name that ends in {_SUFFIX}")
    known, path, config = choose(run, options, fallback, mode, weights)
    backend = find_backend()
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend  # of the child
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--output: {output.parent}: {error.strerror}") from None
    try:
        result = record(
            path.absolute(), known, config, output=output.absolute(), episodes=episodes,
            seed=seed, overlay=overlay, on_words=pass_on, proceed=proceed,
        )  # fmt: skip
    except FaultyEnvironmentError as error:
        hint = f"; nothing draws MuJoCo's pictures here: {HELP}" if backend is None else ""
        raise FaultyEnvironmentError(f"{error}{hint}", by_mistake=error.by_mistake) from None
    if not result:
        return {}
    return {"env": config.env_id, "mode": mode, "output": str(output), **result}


def line(found: dict[str, Any]) -> str:
    """Give the result of `record_run` in one line."""
    returns = ", ".join(written(episode_return) for episode_return in found["returns"])
    return (
        f"{found['output']}: {found['frames'] / found['fps']:.0f} s of {found['env']} "
        f"({found['mode']}), return {returns}"
    )
