"""Which environment a run plays and how it is made; every Welcome has it."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from a2s.protocol.checks import MAX_METRICS, METRIC_NAME, is_metric_name, require
from a2s.protocol.errors import UsageError

TIMEOUT_S = 120.0
ALWAYS_METRIC = "is_success"
_MAX = (1 << 31) - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """The environment of a run and its wrappers, from the inside out."""

    env_id: str  # Gymnasium id, module:Id-v0, module:Class, or PATH.py: with either
    kwargs: str = "{}"  # of its constructor, a JSON object; texts may hold {worker}, {env_index}
    wrappers: tuple[str, ...] = ()  # module:Class or module:Class={JSON object}, innermost first
    action_repeat: int = 1  # steps of the environment for each of ours; rewards are summed
    frame_stack: int = 1  # observations, the newest last, in each of ours
    max_episode_steps: int = 0  # its steps until truncation; 0: as the environment does
    timeout_s: float = TIMEOUT_S  # for one call into it
    info_metrics: tuple[str, ...] = ()  # keys of info kept with each episode, besides is_success

    def __post_init__(self) -> None:
        """Check the ranges."""
        require(bool(self.env_id), "environment", repr(self.env_id), "an id")
        for name, low in (("action_repeat", 1), ("frame_stack", 1), ("max_episode_steps", 0)):
            found = getattr(self, name)
            require(low <= found <= _MAX, f"environment: {name}", found, f"{low} to {_MAX}")
        timeout_s = self.timeout_s
        require(0 < timeout_s < math.inf, "environment: timeout_s", timeout_s, "above 0 s")
        is_object = isinstance(_loads(self.kwargs), dict)
        require(is_object, "environment: kwargs", repr(self.kwargs), "a JSON object")
        subject, count = "environment: info_metrics", len(self.metric_names)
        require(count <= MAX_METRICS, subject, count, f"at most {MAX_METRICS} with {ALWAYS_METRIC}")
        for name in self.info_metrics:
            require(is_metric_name(name), subject, repr(name), METRIC_NAME)

    def to_json(self) -> str:
        """Return it as JSON, for another process or a policy file."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "EnvConfig":
        """Read it; unknown entries are ignored.

        Raises:
            ValueError, TypeError, MalformedMessageError: It is not an environment's JSON.
        """
        found: dict[str, Any] = json.loads(text)
        known: dict[str, Any] = {f.name: found[f.name] for f in fields(cls) if f.name in found}
        known |= {k: tuple(v) for k, v in known.items() if isinstance(v, list)}
        return cls(**known)

    def constructor_arguments(self, worker: int, env_index: int) -> dict[str, Any]:
        """Return the keyword arguments for one environment, its numbers filled in."""
        numbers = {"{worker}": worker, "{env_index}": env_index}
        arguments: dict[str, Any] = json.loads(self.kwargs)
        return {name: _filled(value, numbers) for name, value in arguments.items()}

    @property
    def code(self) -> tuple[str, ...]:
        """What is imported for it, or run, as ``module:Name`` or ``PATH.py:Name``."""
        named = (self.env_id, *(wrapper.partition("=")[0].strip() for wrapper in self.wrappers))
        return tuple(name for name in named if ":" in name)

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Keys of ``info`` that are read when an episode ends, each once."""
        return tuple(dict.fromkeys((ALWAYS_METRIC, *self.info_metrics)))


def kwargs_of(settings: Sequence[str]) -> str:
    """Make the JSON object of ``KEY=VALUE`` settings; a value that is not JSON is a text.

    Raises:
        UsageError: A setting is not ``KEY=VALUE``.
    """
    arguments = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or not name.strip().isidentifier():
            raise UsageError(f"--env-kwargs: found {setting!r}, expected KEY=VALUE")
        found = _loads(value)
        arguments[name.strip()] = value if found is None and value.strip() != "null" else found
    return json.dumps(arguments)


def wrapper_of(setting: str) -> tuple[str, str, dict[str, Any]]:
    """Split ``module:Class={JSON object}`` into module, class and keyword arguments.

    Raises:
        UsageError: It is not of that form.
    """
    place, equals, text = setting.partition("=")
    module, colon, name = place.strip().rpartition(":")
    arguments = _loads(text) if equals else {}
    if not (colon and module and name.isidentifier() and isinstance(arguments, dict)):
        raise UsageError(
            f"--wrapper: found {setting!r:.100}, expected module:Class or "
            'module:Class={"argument": value}'
        )
    return module, name, arguments


def _loads(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _filled(value: Any, numbers: dict[str, int]) -> Any:
    if not isinstance(value, str):
        return value
    if value in numbers:
        return numbers[value]
    for name, number in numbers.items():
        value = value.replace(name, str(number))
    return value
