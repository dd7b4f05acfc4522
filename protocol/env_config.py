"""Which environment a run plays, and how it is made: told to every actor by the handshake."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from a2s.protocol.errors import UsageError
from a2s.protocol.fields import METRIC_NAME, MOST_METRICS, is_metric_name, require

TIMEOUT_S = 120.0
ALWAYS_METRIC = "is_success"
_MOST = (1 << 31) - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvConfig:
    """The environment of a run, and what is wrapped round it, from the inside out.

    Attributes:
        env_id: Gymnasium id, ``module:Id-v0``, ``module:Class``, or ``PATH.py:`` with either.
        kwargs: Keyword arguments of its constructor, a JSON object. In an argument that is a text
            ``{worker}`` and ``{env_index}`` stand for the numbers of the actor process and of the
            environment in it.
        wrappers: ``module:Class`` or ``module:Class={JSON object}``, the innermost first.
        action_repeat: Steps of the environment for each of ours; rewards are added up.
        frame_stack: Observations, the newest last, that make one of ours.
        max_episode_steps: Steps of the environment after which an episode is truncated; 0 leaves
            it to the environment.
        timeout_s: Seconds in which a call into it has to return.
        info_metrics: Keys of ``info`` whose numbers are kept with each episode, besides
            ``is_success``; 32 with it at most.

    Raises:
        MalformedMessageError: A number is out of range, ``kwargs`` is no JSON object, or there are
            too many metrics, or one has a name that cannot be shown.
    """

    env_id: str
    kwargs: str = "{}"
    wrappers: tuple[str, ...] = ()
    action_repeat: int = 1
    frame_stack: int = 1
    max_episode_steps: int = 0
    timeout_s: float = TIMEOUT_S
    info_metrics: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the ranges."""
        require(bool(self.env_id), "environment", repr(self.env_id), "an id")
        for name, least in (("action_repeat", 1), ("frame_stack", 1), ("max_episode_steps", 0)):
            found = getattr(self, name)
            require(least <= found <= _MOST, f"environment: {name}", found, f"{least} to {_MOST}")
        require(
            0 < self.timeout_s < math.inf, "environment: timeout_s", self.timeout_s, "above 0 s"
        )
        require(
            isinstance(_loads(self.kwargs), dict),
            "environment: kwargs", repr(self.kwargs), "a JSON object",
        )  # fmt: skip
        subject, told = "environment: info_metrics", len(self.metric_names)
        require(told <= MOST_METRICS, subject, told, f"at most {MOST_METRICS} with {ALWAYS_METRIC}")
        for name in self.info_metrics:
            require(is_metric_name(name), subject, repr(name), METRIC_NAME)

    def to_json(self) -> str:
        """Write it for another process, or a policy file."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "EnvConfig":
        """Read it; what it does not know is passed over.

        Raises:
            ValueError, TypeError, MalformedMessageError: It is none.
        """
        found: dict[str, Any] = json.loads(text)
        known: dict[str, Any] = {f.name: found[f.name] for f in fields(cls) if f.name in found}
        known |= {k: tuple(v) for k, v in known.items() if isinstance(v, list)}
        return cls(**known)

    def constructor_arguments(self, worker: int, env_index: int) -> dict[str, Any]:
        """Give the keyword arguments for one environment."""
        numbers = {"{worker}": worker, "{env_index}": env_index}
        arguments: dict[str, Any] = json.loads(self.kwargs)
        return {name: _filled(value, numbers) for name, value in arguments.items()}

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Keys of ``info`` that are looked at when an episode ends, each once."""
        return tuple(dict.fromkeys((ALWAYS_METRIC, *self.info_metrics)))


def kwargs_of(settings: Sequence[str]) -> str:
    """Make the JSON object of ``KEY=VALUE`` settings; a value that is no JSON is a text.

    Raises:
        UsageError: There is no ``=``.
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
    """Take ``module:Class={JSON object}`` apart.

    Returns:
        Module, class, and keyword arguments.

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
