"""A learner without actors keeps only what can be gone on with."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from segments import segment

from a2s.learner.learner import Learner
from a2s.learner.make import make_replay_learner
from a2s.learner.replay.remote import RemoteReplay, ServedReplay
from a2s.learner.replay.replay import Replay
from a2s.learner.run import checkpoint
from a2s.learner.run.config import assemble
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.progress import PlainView
from a2s.protocol.errors import A2SError, RunDirectoryError, UnreachableError, UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.in_process import Exchange, InProcessBus
from a2s.protocol.keys import Keys

SPACES = Spaces(obs_size=3, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))
SMALL = {"critic_sizes": "8", "policy_sizes": "8", "batch_rows": "8", "warm_up_steps": "8"}


def replay(reward: float, spaces: Spaces = SPACES) -> Replay:
    """Twenty steps with the same reward."""
    made = Replay.in_memory("Test-v0", spaces, 100)
    rewards = np.full(20, reward, np.float32)
    sizes = {"obs_size": spaces.obs_size, "action_size": 2}
    made.insert(segment(0, 20, reward=rewards, terminated=True, **sizes))
    return made


def learner(
    path: Path,
    source: Replay | RemoteReplay,
    spaces: Spaces = SPACES,
    *,
    updates: int = 100,
    resume: bool = False,
    metrics: LearnerMetrics | None = None,
    **changed: str,
) -> Learner:
    """Learn for some updates, from twenty transitions."""
    options = {"variant": "off-policy", "preset": "sac", "total_steps": updates}
    return make_replay_learner(
        configuration=assemble(options, SMALL | changed),
        spaces=spaces,
        replay=source,
        size=lambda: 20,
        max_size=20,
        path=path,
        metrics=metrics or LearnerMetrics(),
        view=PlainView(io.StringIO()),
        resume=resume,
    )


def test_no_more_is_waited_for_than_can_come_and_the_end_is_kept(tmp_path: Path) -> None:
    """Twenty transitions of a hundred that a learner with actors would wait for."""
    summary = learner(tmp_path, replay(1.0), warm_up_steps="100").run(lambda: False)
    assert (summary["updates"], summary["env_steps"], summary["finished"]) == (100, 100, True)
    assert {p.name for p in (tmp_path / "checkpoints").iterdir()} == {"00000000", "00000100"}
    header, row = (tmp_path / "updates.csv").read_text().splitlines()
    assert header.startswith("update,wall_s,env_steps,weights_version,epoch,replay_rows,q_loss,")
    assert (row.split(",")[0], *row.split(",")[2:6]) == ("100", "100", "100", "0", "20")


def test_the_steps_that_updates_are_worth_are_counted_by_the_metrics(tmp_path: Path) -> None:
    """Two updates a step; a resumed run counts from where it was."""
    shown = []
    for steps in (50, 150):
        metrics = LearnerMetrics()
        learner(
            tmp_path, replay(1.0), updates=steps, resume=steps > 50, metrics=metrics, utd_ratio="2"
        ).run(lambda: False)
        shown.append(metrics.registry.get_sample_value("a2s_learner_env_steps_total"))
    assert shown == [50.0, 150.0]


def test_a_replay_that_never_holds_a_batch_is_refused(tmp_path: Path) -> None:
    """And nothing is left in the run's directory."""
    reason = "found 20 transitions at most, expected a batch of 21; set batch_rows"
    with pytest.raises(UsageError, match=reason):
        learner(tmp_path, replay(1.0), batch_rows="21")
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_no_numbers_are_not_kept(tmp_path: Path) -> None:
    """A temperature that grows by a factor of e^1000 is none after one update.

    The run can be resumed from what it began with, as after a kill before its first round.
    """
    with pytest.raises(A2SError, match="update 100: found non-finite weights"):
        learner(
            tmp_path, replay(1.0), temperature_learning_rate="1000", entropy_per_action="1000"
        ).run(lambda: False)
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["00000000"]
    assert learner(tmp_path, replay(1.0), resume=True).run(lambda: False)["updates"] == 100


def test_what_was_not_begun_cannot_be_resumed(tmp_path: Path) -> None:
    """And nothing is made in its place."""
    with pytest.raises(RunDirectoryError, match="found no checkpoint"):
        learner(tmp_path / "none", replay(1.0), resume=True)
    assert list(tmp_path.iterdir()) == []


def test_observations_may_be_as_wide_as_a_batch_of_them_can_be_sent(tmp_path: Path) -> None:
    """Four thousand of the size of a thousand, for their mean, are more than a message takes."""
    wide = dataclasses.replace(SPACES, obs_size=1000)
    exchange, keys = Exchange(), Keys("wide")
    ServedReplay(InProcessBus(exchange), keys, replay(1.0, wide), 1, share=1.0).open()
    remote = RemoteReplay(InProcessBus(exchange), keys)
    assert learner(tmp_path, remote, wide).run(lambda: False)["updates"] == 100


def test_a_replay_that_is_gone_ends_the_run_and_what_was_learned_is_kept(tmp_path: Path) -> None:
    exchange, keys = Exchange(), Keys("gone")
    server = InProcessBus(exchange)
    ServedReplay(server, keys, replay(1.0), 1, share=1.0).open()
    remote = RemoteReplay(InProcessBus(exchange), keys)
    run = learner(tmp_path, remote, updates=1000)
    rounds = iter([lambda: None, lambda: None, server.close])

    def stopped() -> bool:
        next(rounds)()
        return False

    with pytest.raises(UnreachableError, match=r"no answer.* Go on with --resume"):
        run.run(stopped)
    kept = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert kept == ["00000000", "00000200"]


def test_the_size_of_returns_is_drawn_from_the_replay_before_every_twentieth_update(
    tmp_path: Path,
) -> None:
    """Rewards of 3, of what follows a thousandth: 3.003, and 3 at the end."""
    learner(tmp_path, replay(3.0), norm_return="true", gamma="0.001").run(lambda: False)
    tensors, _ = checkpoint.load(
        tmp_path / "checkpoints", kind="off-policy on Hopper-v5 from a replay"
    )
    assert float(tensors["return_size.samples"]) == 5
    assert float(tensors["return_size.mean_square"]) == pytest.approx(9.017, abs=0.02)


def test_a_run_that_was_resumed_is_one_that_went_on(tmp_path: Path) -> None:
    """To the bit, though a batch had been drawn ahead when it stopped."""
    source, found = replay(1.0), []
    for name, ends in (("on", (300,)), ("resumed", (100, 300))):
        for updates in ends:
            resume = updates > ends[0]
            made = learner(
                tmp_path / name, source, updates=updates, resume=resume, norm_return="true"
            )
            made.run(lambda: False)
        folder = tmp_path / name / "checkpoints"
        found.append(checkpoint.load(folder, kind="off-policy on Hopper-v5 from a replay")[0])
    on, resumed = found
    assert all(torch.equal(on[name], resumed[name]) for name in on | resumed)
