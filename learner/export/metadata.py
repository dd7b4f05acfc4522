"""The environment that a policy was trained on, in the metadata of its file."""

import json
from collections.abc import Sequence

from a2s.learner.run.run_config import RunConfig
from a2s.protocol.fields import Spaces


def policy_metadata(
    run: RunConfig, spaces: Spaces, layout: Sequence[tuple[str, int]] = ()
) -> dict[str, str]:
    """Write the entries of docs/protocol.md, "The graph", that belong to the run."""
    found = {"env": run.env, "algo": run.algo, "environment": run.env_config().to_json()}
    if [*layout] not in ([], [("obs", spaces.obs_size)]):
        found["obs_layout"] = json.dumps([*layout])
    if spaces.obs_offset is not None:
        found["obs_offset"] = json.dumps(spaces.obs_offset.tolist())
    return found
