"""The options that say how the environment is made and wrapped."""

from collections.abc import Mapping
from typing import Annotated, Any

from a2s.commands.options import option, whole

_ENVIRONMENT = "The environment"
_OPTIONS = {
    "wrappers": "--wrapper",
    "env_timeout_s": "--env-timeout",
    "info_metrics": "--info-metric",
}

EnvKwargs = Annotated[
    list[str] | None,
    option(
        "--env-kwargs",
        env="A2S_ENV_KWARGS",
        help="KEY=VALUE of its constructor, VALUE in JSON or a text; may be repeated.",
        panel=_ENVIRONMENT,
        metavar="KEY=VALUE",
    ),
]
Wrapper = Annotated[
    list[str] | None,
    option(
        "--wrapper",
        env="A2S_WRAPPER",
        help="module:Class or module:Class={JSON} round it; may be repeated, innermost first.",
        panel=_ENVIRONMENT,
        metavar="CLASS",
    ),
]
ActionRepeat = Annotated[
    int | None,
    whole(
        "--action-repeat",
        env="A2S_ACTION_REPEAT",
        help="Its steps for each action; rewards are added up.",
        panel=_ENVIRONMENT,
        least=1,
        most=1000,
        show_default="1",
    ),
]
FrameStack = Annotated[
    int | None,
    whole(
        "--frame-stack",
        env="A2S_FRAME_STACK",
        help="Latest observations that the policy sees at once.",
        panel=_ENVIRONMENT,
        least=1,
        most=1000,
        show_default="1",
    ),
]
MaxEpisodeSteps = Annotated[
    int | None,
    whole(
        "--max-episode-steps",
        env="A2S_MAX_EPISODE_STEPS",
        help="Its steps after which an episode is cut.",
        panel=_ENVIRONMENT,
        least=1,
        most=2**31 - 1,
        show_default="its own limit",
    ),
]
EnvTimeout = Annotated[
    float | None,
    option(
        "--env-timeout",
        env="A2S_ENV_TIMEOUT",
        help="Seconds in which a call into it has to return; else its process is replaced.",
        panel=_ENVIRONMENT,
        metavar="SECONDS",
        min=0.001,
        show_default="120",
    ),
]
InfoMetric = Annotated[
    list[str] | None,
    option(
        "--info-metric",
        env="A2S_INFO_METRIC",
        help="Key of info whose number is kept with each episode, besides is_success; repeatable.",
        panel=_ENVIRONMENT,
        metavar="KEY",
    ),
]


def environment(
    env_kwargs: list[str] | None,
    wrapper: list[str] | None,
    action_repeat: int | None,
    frame_stack: int | None,
    max_episode_steps: int | None,
    env_timeout: float | None,
    info_metric: list[str] | None,
) -> dict[str, Any]:
    """Name the options of an environment as a configuration does."""
    return {
        "env_kwargs": tuple(env_kwargs) if env_kwargs else None,
        "wrappers": tuple(wrapper) if wrapper else None,
        "action_repeat": action_repeat,
        "frame_stack": frame_stack,
        "max_episode_steps": max_episode_steps,
        "env_timeout_s": env_timeout,
        "info_metrics": tuple(info_metric) if info_metric else None,
    }


def words(given: Mapping[str, Any]) -> list[str]:
    """Write what was given, as :func:`environment` names it, on a command line again."""
    line: list[str] = []
    for name, value in given.items():
        option = _OPTIONS.get(name, f"--{name.replace('_', '-')}")
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        line += [word for v in values for word in (option, str(v))]
    return line
