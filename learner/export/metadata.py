"""What a policy file says of the environment that it was trained on."""

import json
from collections.abc import Sequence

from a2s.learner.run.run_config import RunConfig
from a2s.protocol.fields import Spaces


def policy_metadata(
    run: RunConfig, spaces: Spaces, layout: Sequence[tuple[str, int]] = ()
) -> dict[str, str]:
    """Write the entries of docs/protocol.md, "The graph", that are the run's.

    Args:
        run: Its options.
        spaces: Of its environment.
        layout: Names and sizes of the parts of an observation, where they are known.
    """
    found = {"env": run.env, "algo": run.algo, "environment": run.env_config().to_json()}
    if [*layout] not in ([], [("obs", spaces.obs_size)]):
        found["obs_layout"] = json.dumps([*layout])
    if spaces.obs_offset is not None:
        found["obs_offset"] = json.dumps(spaces.obs_offset.tolist())
    return found
