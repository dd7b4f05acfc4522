"""The code that an actor imports because a learner says so: what its own user has allowed."""

import shlex
from collections.abc import Sequence

from a2s.actors.environments.making import file_of
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import UsageError


def require_allowed(config: EnvConfig, allowed: Sequence[str]) -> None:
    """Look at where the code of an environment and its wrappers comes from.

    Ids that Gymnasium knows name none. ``allowed`` are modules and files, with ``:NAME`` for
    nothing else in them.

    Raises:
        UsageError: Some of it is not allowed.
    """
    for code in config.code:
        if not any(_covers(each, code) for each in allowed):
            place = code.rpartition(":")[0]
            if place.endswith(".py"):
                place = str(file_of(place))
            raise UsageError(
                f"environment {config.env_id!r}: the learner wants {code!r:.200}, code that this "
                f"actor was not told to run; if you trust it: --allow-env {shlex.quote(place):.200}"
            )


def _covers(allowed: str, code: str) -> bool:
    place, _, name = code.rpartition(":")
    module, colon, only = allowed.rpartition(":")
    module = module if colon else allowed
    if colon and only != name:
        return False
    if place.endswith(".py") or module.endswith(".py"):
        return place.endswith(".py") and file_of(place).resolve() == file_of(module).resolve()
    return place == module or place.startswith(f"{module}.")
