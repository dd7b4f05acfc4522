"""Groups of options that several commands take: each is listed once, here."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from a2s.commands import options

Group = Mapping[str, Any]  # of parameters by name: how they are read; none has to be given

ENVIRONMENT: Group = {
    "env": options.Env,
    "env_kwargs": options.EnvKwargs,
    "wrappers": options.Wrapper,
    "action_repeat": options.ActionRepeat,
    "frame_stack": options.FrameStack,
    "max_episode_steps": options.MaxEpisodeSteps,
    "env_timeout_s": options.EnvTimeout,
    "info_metrics": options.InfoMetric,
}
ALGORITHM: Group = {
    "total_steps": options.TotalSteps,
    "seed": options.Seed,
    "variant": options.Variant,
    "algo": options.Algo,
    "preset": options.Preset,
    "envs": options.Envs,
    "evaluation_episodes": options.EvaluationEpisodes,
}
RUN: Group = {  # in the order of the help
    "env": options.Env,
    "total_steps": options.TotalSteps,
    "seed": options.Seed,
    "run": options.Run,
    "init_from": options.InitFrom,
    "evaluate_every": options.EvaluateEvery,
    "evaluation_episodes": options.EvaluationEpisodes,
    "stop_at_return": options.StopAtReturn,
    "keep_policy_every_updates": options.KeepPolicyEvery,
    "tensorboard": options.Tensorboard,
    **ENVIRONMENT,
    **ALGORITHM,
    "suggestions": options.Suggestions,
    "recovery": options.Recovery,
    "lockstep": options.Lockstep,
    "prior": options.Prior,
    "prior_share": options.PriorShare,
    "n": options.N,
    "threads": options.Threads,
    "device": options.Device,
}


def taking(*groups: Group) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Have a command take the options of groups as well; it reads them from its context.

    They come before its own in the help: ``options.named(context, GROUP)`` reads them.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True)
        kind = inspect.Parameter.KEYWORD_ONLY
        added = [
            inspect.Parameter(name, kind, default=None, annotation=hint)
            for group in groups
            for name, hint in group.items()
            if name not in own.parameters
        ]

        @functools.wraps(command)
        def called(**given: Any) -> None:
            command(**{name: given[name] for name in own.parameters})

        found = [*added, *(each.replace(kind=kind) for each in own.parameters.values())]
        called.__signature__ = own.replace(parameters=found)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in found}
        return called

    return decorate
