"""The fault of an environment, in one line that ends with the user's file and line."""

import dis
import inspect
import os
import reprlib
import sysconfig
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator

from a2s.protocol.errors import FaultyEnvironmentError, one_line, said_by

_OURS = str(Path(__file__).resolve().parents[1])
_GYMNASIUM = str(Path(gymnasium.__file__).resolve().parent)
_STDLIB = str(Path(sysconfig.get_paths()["stdlib"]).resolve())
_SITE = ("site-packages", "dist-packages")
_GYMNASIUM_ADDS = " was raised from the environment creator"
_STEP = "5 (obs, reward, terminated, truncated, info)"

Env = gymnasium.Env[Any, Any]


class Faults:
    """Makes the errors of one environment."""

    def __init__(self, env_id: str) -> None:
        self._env_id = env_id
        self._pid = os.getpid()

    def raised(self, call: str, error: BaseException, place: str = "") -> FaultyEnvironmentError:
        """It raised something."""
        self._end_copy(error)
        return self._fault(
            f"{call} raised {said_by(error)}", place or place_of(error), by_mistake=False
        )

    def of_make(self, error: BaseException, made: Any = None) -> FaultyEnvironmentError:
        """Its constructor, ``made`` if known, failed or did not make an environment."""
        constructor = made or self._constructor()
        if isinstance(error.__context__, TypeError) and _GYMNASIUM_ADDS in str(error):
            error = error.__context__
        is_of_call = isinstance(error, TypeError) and not _is_of_users(error)
        if is_of_call and "unexpected keyword argument" in str(error):
            words = " ".join(str(error).split())
            taken = inspect.signature(constructor).parameters if constructor else ()
            what = f"make: {words}; it takes {', '.join(taken) or 'no arguments'}"
            return self._fault(what, _place_of_init(constructor))
        return self.raised("make", error, place_of(error) or _place_of_init(constructor))

    def of_wrapper(
        self, wrapper: Callable[..., Env], error: BaseException
    ) -> FaultyEnvironmentError:
        """A wrapper's constructor failed."""
        name = f"wrapper {wrapper.__module__}:{getattr(wrapper, '__name__', '')}"
        return self.raised(name, error, place_of(error) or _place_of_init(wrapper))

    def of_call(
        self,
        call: Literal["reset", "step"],
        env: Env,
        error: BaseException,
        again: Callable[[Env], Any],
    ) -> FaultyEnvironmentError:
        """A reset or step failed, in the user's code or because of the value that it returned.

        ``again`` makes the same call of one of the layers of ``env``, to see what that returns.
        """
        if _is_of_users(error) or os.getpid() != self._pid:
            return self.raised(call, error)
        layer = layer_with(env, call)
        place = place_of_return(layer, call)
        try:
            result = again(layer)
        except BaseException as other:  # noqa: BLE001  # whatever a user's code raises
            return self.raised(call, other)
        wrong = (wrong_reset if call == "reset" else _wrong_step)(result)
        wrong = wrong or _wrong_obs(call, result[0], layer)
        return self._fault(wrong, place) if wrong else self.raised(call, error, place)

    def returned(self, env: Env, call: str, what: str) -> FaultyEnvironmentError:
        """It returned an invalid value."""
        return self._fault(f"{call} returned {what}", place_of_return(layer_with(env, call), call))

    def misfit(
        self, env: Env, call: str, obs: Any, size: int, error: BaseException | None = None
    ) -> FaultyEnvironmentError:
        """It gave an observation that is not made of ``size`` numbers, or cannot be converted."""
        layer = layer_with(env, call)
        wrong = _wrong_obs(call, obs, layer)
        if not wrong:
            try:
                if obs is None:
                    raise TypeError
                what = f"of {np.asarray(obs, dtype=np.float64).size} numbers"
            except Exception:  # noqa: BLE001  # a user's object may raise anything
                what = brief(obs) + (f" ({said_by(error)})" if error else "")
            wrong = f"{call} returned an observation {what}, expected {size}"
        return self._fault(wrong, place_of_return(layer, call))

    def _end_copy(self, error: BaseException) -> None:
        """End a copy of this process that a user's code has forked; it is not our child."""
        if os.getpid() != self._pid:
            code = error.code if isinstance(error, SystemExit) else 1
            os._exit(code if isinstance(code, int) else int(code is not None))

    def _constructor(self) -> Any:
        spec = gymnasium.registry.get(self._env_id.rpartition(":")[2])
        made = spec.entry_point if spec is not None else None
        try:
            return load_env_creator(made) if isinstance(made, str) else made
        except (ImportError, AttributeError):
            return None

    def _fault(self, what: str, place: str, *, by_mistake: bool = True) -> FaultyEnvironmentError:
        where = f" ({place})" if place else ""
        line = f"environment {self._env_id}: {one_line(what)}{where}"
        return FaultyEnvironmentError(line, by_mistake=by_mistake)


def _place_of_init(made: Any) -> str:
    code = getattr(getattr(made, "__init__", None), "__code__", None)
    code = code or getattr(made, "__code__", None)
    return f"{_shown(code.co_filename)}:{code.co_firstlineno}" if code else ""


def layer_with(env: Env, method: str) -> Env:
    """Find the outermost of the wrapped environments in which a user has written a method."""
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        written = _file_of(getattr(type(layer), method, None))
        if written and not written.startswith((_GYMNASIUM, _OURS)):
            return layer
        layer = layer.env
    return layer


def place_of_return(env: Env, method: str) -> str:
    """Name the file and the line of the last ``return`` of a method."""
    function = getattr(type(env), method, None)
    code = getattr(inspect.unwrap(function), "__code__", None) if function else None
    if code is None:
        return ""
    lines = [
        i.positions.lineno
        for i in dis.get_instructions(code)
        if i.opname.startswith("RETURN") and i.positions and i.positions.lineno
    ]
    return f"{_shown(code.co_filename)}:{max(lines, default=code.co_firstlineno)}"


def place_of(error: BaseException) -> str:
    """Name the file and line in the user's code where an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [f for f in frames if not _is_library(f.filename)]
    own = [f for f in theirs if not any(part in f.filename for part in _SITE)]
    if not theirs:
        return ""
    frame = (own or theirs)[-1]
    return f"{_shown(frame.filename)}:{frame.lineno}"


def wrong_reset(result: Any) -> str:
    """Say why the result of a reset cannot be ``(obs, info)``; empty if it can be."""
    if not isinstance(result, tuple | list):
        return f"reset returned {brief(result)} and no info, expected (obs, info)"
    if len(result) != 2:
        return f"reset returned {len(result)} values, expected 2 (obs, info)"
    if not isinstance(result[1], Mapping):
        return f"reset returned no info but {brief(result[1])}, expected (obs, info)"
    return ""


def brief(value: Any) -> str:
    """Show any value in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return f"{reprlib.repr(value):.80}"


def _wrong_step(result: Any) -> str:
    if not isinstance(result, tuple | list):
        return f"step returned {brief(result)}, expected {_STEP}"
    if len(result) != 5:
        return f"step returned {len(result)} values, expected {_STEP}"
    return ""


def _wrong_obs(call: str, obs: Any, layer: Env) -> str:
    space = layer.observation_space
    if isinstance(space, gymnasium.spaces.Dict) and isinstance(obs, Mapping):
        missing = [key for key in space if key not in obs]
        if missing:
            return f"{call} returned an observation without {missing}, expected {list(space)}"
        for key, part in space.items():
            if not _fits(obs[key], part):
                return f"{call} returned {brief(obs[key])} as {key!r}, expected {part}"
        return ""
    if isinstance(space, gymnasium.spaces.Box):
        return ""  # whoever makes numbers of it tells
    return "" if space.contains(obs) else f"{call} returned {brief(obs)}, expected {space}"


def _fits(value: Any, space: "gymnasium.Space[Any]") -> bool:
    """Whether numbers can be made of a part; of a Box, whatever its dtype and bounds."""
    if not isinstance(space, gymnasium.spaces.Box):
        return bool(space.contains(value))
    try:
        return bool(np.asarray(value, dtype=np.float64).size == np.prod(space.shape, dtype=int))
    except (TypeError, ValueError):
        return False


def _is_of_users(error: BaseException) -> bool:
    """Whether the user's code, or code below it, raised this, not our reading of its result."""
    frames = traceback.extract_tb(error.__traceback__)
    return any(not _is_library(frame.filename) for frame in frames)


def _is_library(file: str) -> bool:
    path = str(Path(file).resolve()) if not file.startswith("<") else file
    if path.startswith((_OURS, _GYMNASIUM)) or "numpy" in Path(path).parts:
        return "gymnasium/envs/" not in path or path.endswith("registration.py")
    is_installed = any(part in path for part in _SITE)
    return file.startswith("<") or (path.startswith(_STDLIB) and not is_installed)


def _file_of(function: Any) -> str:
    code = getattr(inspect.unwrap(function), "__code__", None) if function else None
    return str(Path(code.co_filename).resolve()) if code else ""


def _shown(file: str) -> str:
    """Give a path as a user would: relative to the working directory, if it is below that."""
    path = Path(file)
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):  # not below it, or it is gone
        return file
