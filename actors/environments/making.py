"""Making an environment from the options of a run: its id, its arguments, its wrappers."""

import dataclasses
import importlib
import importlib.util
import inspect
import os
import random
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs import registration

from a2s.actors.environments.faults import Env, Faults
from a2s.protocol.env_config import EnvConfig, wrapper_of
from a2s.protocol.errors import A2SError, UsageError

MAX_SEED = 0x7FFF_FFFF  # what an int of C holds
_SHOWN = 8
_START = Path.cwd()  # an environment may go elsewhere

# Otherwise MuJoCo prints and leaves a MUJOCO_LOG.TXT behind, also for outdated models.
mujoco.set_mju_user_warning(lambda _words: None)


def make(config: EnvConfig, worker: int, env_index: int) -> tuple[Env, bool]:
    """Make an environment; give it, and whether its reset takes a seed.

    Raises:
        UsageError: A module, id, class, wrapper or argument of Gymnasium's does not exist.
        Exception: Whatever the constructor raises.
    """
    os.environ["A2S_WORKER"], os.environ["A2S_ENV_INDEX"] = str(worker), str(env_index)
    env = _construct(config, config.constructor_arguments(worker, env_index))
    for setting in config.wrappers:
        module, name, arguments = wrapper_of(setting)
        wrapper = _named(module, name)
        try:
            env = wrapper(env, **arguments)
        except BaseException as error:  # whatever a user's code raises
            raise Faults(config.env_id).of_wrapper(wrapper, error) from error
    return env, _mend_resets(env)


def seed_globals(seed: int) -> None:
    """Seed ``random`` and ``np.random``, which environments use though they should not."""
    random.seed(seed)
    np.random.seed(seed % (1 << 32))  # noqa: NPY002  # the very thing that they use


def limit_of(env: Env) -> int | None:
    """Give the steps after which Gymnasium truncates an episode; ``None``: it never does."""
    spec = getattr(env, "spec", None)  # a wrapper of the user's may have none
    return spec.max_episode_steps if spec is not None else None


def _construct(config: EnvConfig, arguments: dict[str, Any]) -> Env:
    place, _, name = config.env_id.rpartition(":")
    more: dict[str, Any] = {"disable_env_checker": True}
    made = None
    if config.max_episode_steps:
        more["max_episode_steps"] = config.max_episode_steps
    with warnings.catch_warnings():
        # Gymnasium announces newer versions of an id; the user chose this one.
        warnings.simplefilter("ignore", DeprecationWarning)
        # If it cannot draw, whoever wants a video is told so in one line.
        warnings.filterwarnings("ignore", ".*not in the possible render_modes")
        try:
            module = _module(place, f"environment {config.env_id!r}") if place else None
            if name in gymnasium.registry:
                spec = gymnasium.registry[name]
            elif module is None:
                return gymnasium.make(name, **more, **arguments)  # it knows what is meant, or not
            else:
                made = _in_module(config.env_id, module, name)
                spec = registration.EnvSpec(id=f"{name}-v0", entry_point=made)
            # One of the same name as an argument of `make` would not reach the environment.
            return gymnasium.make(
                dataclasses.replace(spec, kwargs={**spec.kwargs, **arguments}), **more
            )
        except gymnasium.error.Error as error:
            advice = f"; name what is in it: {name}:CLASS" if name.endswith(".py") else ""
            raise UsageError(f"environment {config.env_id!r}: {_line(error)}{advice}") from None
        except Exception as error:  # whatever a user's code raises
            if made is None or isinstance(error, A2SError):
                raise
            raise Faults(config.env_id).of_make(error, made) from error


def _in_module(env_id: str, module: Any, name: str) -> Any:
    """Find a class or function that makes an environment in a module where the id is unknown."""
    made = getattr(module, name, None)
    if callable(made):
        return made
    classes = [n for n, found in vars(module).items() if isinstance(found, type)]
    own = sorted(n for n in classes if issubclass(getattr(module, n), gymnasium.Env))
    more = ", ..." if len(own) > _SHOWN else ""
    there = f"there are {', '.join(own[:_SHOWN])}{more}" if own else "it has no environment"
    raise UsageError(f"environment {env_id!r}: found neither an id nor a class {name!r}; {there}")


def _module(place: str, subject: str) -> Any:
    """Import the module of an environment, or run its file."""
    if not place.endswith(".py"):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError as error:
            if error.name is None or not place.startswith(error.name):
                raise  # it is there, and lacks something itself
            raise UsageError(
                f"{subject}: {place}: {_line(error)}; install it, run where it lies, or name its "
                "file: ./FILE.py:NAME"
            ) from None
    path = file_of(place)
    if not path.exists():
        raise UsageError(f"{subject}: {place}: found no such file, nor {path.name} in {_START}")
    path = path.resolve()
    loaded = sys.modules.get(path.stem)
    if loaded is not None and getattr(loaded, "__file__", None) == str(path):
        return loaded
    sys.path.append(str(path.parent))
    return _run_file(path, subject)


def file_of(place: str) -> Path:
    """The file of an environment: what is named, or else that of the same name where we began."""
    path = Path(place)
    return path if path.exists() else _START / path.name  # it may be another machine's directory


def _run_file(path: Path, subject: str) -> Any:
    found = importlib.util.spec_from_file_location(path.stem, path)
    assert found is not None
    assert found.loader is not None
    module = sys.modules[path.stem] = importlib.util.module_from_spec(found)
    try:
        found.loader.exec_module(module)
    except ImportError as error:
        if "relative import" not in str(error):
            raise
        raise UsageError(
            f"{subject}: {path.name}: it imports from the package that it is a part of; name it "
            f"as Python does, PACKAGE.{path.stem}:NAME, in the directory above the package"
        ) from None
    return module


def _named(module: str, name: str) -> Callable[..., Env]:
    try:
        found = getattr(_module(module, "--wrapper"), name, None)
    except ImportError as error:
        raise UsageError(f"--wrapper: {_line(error)}") from None
    if not callable(found):
        raise UsageError(f"--wrapper: found no {name!r} in {module}, expected a class there")
    made: Callable[..., Env] = found
    return made


def _mend_resets(env: Env) -> bool:
    """Let every ``reset()`` that takes no seed or options be called with both.

    Returns:
        Whether all of them take a seed.
    """
    layer, takes_seed = env, True
    while True:
        accepted = _accepted(layer)
        takes_seed = takes_seed and "seed" in accepted
        if accepted != {"seed", "options"}:
            layer.reset = _without(layer.reset, accepted)  # type: ignore[method-assign]
        if not isinstance(layer, gymnasium.Wrapper):
            return takes_seed
        layer = layer.env


def _accepted(env: Env) -> set[str]:
    try:
        parameters = inspect.signature(env.reset).parameters
    except (TypeError, ValueError):
        return {"seed", "options"}
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return {"seed", "options"}
    return {"seed", "options"} & parameters.keys()


def _without(reset: Callable[..., Any], accepted: set[str]) -> Callable[..., Any]:
    def called(*, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        given = {"seed": seed, "options": options}
        return reset(**{name: given[name] for name in accepted})

    return called


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()).rstrip(".")


def as_usage(config: EnvConfig, error: BaseException) -> A2SError | None:
    """The error as the user's mistake; ``None`` if the environment is at fault."""
    if isinstance(error, A2SError):
        return error
    if isinstance(error, ImportError):
        return UsageError(
            f"environment {config.env_id!r}: {_line(error)}; install it, or name another"
        )
    return None
