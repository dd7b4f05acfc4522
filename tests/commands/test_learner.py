"""``a2s learner --replay-from``: what it finds in the directory of a replay."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from replay_oracle import ENV_ID, SPACES, make_segment

from a2s.commands.learn_from import source_of
from a2s.learner.replay import directory
from a2s.learner.run.config import off_policy
from a2s.protocol.identity import Security


@pytest.mark.parametrize(("exponent", "share"), [(0.0, 0.1), (0.5, 10 / 19), (1.0, 100 / 109)])
def test_files_are_drawn_from_by_the_exponent_of_who_learns(
    tmp_path: Path, exponent: float, share: float
) -> None:
    """Ten transitions, one with a priority of 100 and the others with 1."""
    replay = directory.create(tmp_path / "replay", ENV_ID, SPACES, 100)
    replay.insert(make_segment([float(i) for i in range(11)], [1.0] * 10))
    replay.update_priorities(np.arange(10), np.array([100.0] + [1.0] * 9))
    replay.close()
    hyper = off_policy("sac", {"priority_exponent": exponent})
    with ExitStack() as stack:
        found, about, size, most = source_of(str(tmp_path), "", Security(), stack, hyper)
        batch = found.sample(10_000, np.random.default_rng(0), prioritised=True)
    assert (about.env_id, size(), most) == (ENV_ID, 10, 10)
    assert (batch.row == 0).mean() == pytest.approx(share, abs=0.001)
