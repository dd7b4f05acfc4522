"""Learners of tests: everything that does not matter is given."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from a2s.learner.learner import Learner
from a2s.learner.make import make_learner
from a2s.learner.run.config import assemble
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import PlainView, View
from a2s.protocol.fields import Spaces
from a2s.protocol.transport import Bus

SPACES = Spaces(obs_size=2, action_low=-np.ones(1, np.float32), action_high=np.ones(1, np.float32))


def learner_of(
    options: Mapping[str, Any],
    settings: Mapping[str, Any],
    bus: Bus,
    path: Path,
    *,
    spaces: Spaces = SPACES,
    view: View | None = None,
    resume: bool = False,
    mark: int = 0,
) -> Learner:
    """A learner with actors; ``settings`` are of the run and of the algorithm."""
    return make_learner(
        configuration=assemble(dict(options), dict(settings)),
        spaces=spaces,
        layout=(),
        episode_limit=None,
        bus=bus,
        path=path,
        metrics=LearnerMetrics(),
        view=view or PlainView(io.StringIO()),
        resume=resume,
        mark=mark,
    )
