"""The off-policy variant in the learner's loop: how much is learned, from what, when to wait."""

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from a2s.actors.suggester import Suggester
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.off_policy_trainer import OffPolicyLearning
from a2s.learner.run.config import off_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Saved
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Segment

SPACES = Spaces(obs_size=3, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))
SMALL: dict[str, Any] = {
    "critic_sizes": "16,16", "policy_sizes": "16,16", "batch_rows": 8, "replay_rows": 1000,
    "warm_up_steps": 20, "send_every_steps": 5, "lead_steps": 10,
}  # fmt: skip
Learn = Callable[..., OffPolicyLearning]


@pytest.fixture
def learning(tmp_path: Path) -> Learn:
    """Make one, in the directory ``place``."""

    def make(
        place: str = "run", env_id: str = "Test-v0", saved: Saved | None = None, **options: Any
    ) -> OffPolicyLearning:
        path = tmp_path / place
        path.mkdir(exist_ok=True)
        ledger = Ledger(path / "segments.log")
        hyper = off_policy("modern", {**SMALL, **options})
        metrics = LearnerMetrics()
        return OffPolicyLearning(env_id, SPACES, hyper, 7, path, ledger, metrics, "cpu", saved)

    return make


def segment(seq: int, steps: int = 5, place: Path | None = None) -> Segment:
    """Steps whose reward is large when the action is near 0.5; told to the ledger of ``place``."""
    rng = np.random.default_rng(seq)
    action = rng.uniform(-1, 1, (steps, 2)).astype(np.float32)
    if place is not None:
        ledger = Ledger(place / "segments.log")
        ledger.record("a", seq, "accepted", steps)
        ledger.close()
    return Segment(
        actor="a", seq=seq, generation=1, epoch=0, weights_version=1, env=0,
        obs=rng.standard_normal((steps, 3)).astype(np.float32), suggestion=action,
        log_prob=np.zeros(steps, np.float32),
        reward=-np.square(action - 0.5).sum(1).astype(np.float32),
        final_obs=np.zeros(3, np.float32), terminated=True, truncated=False,
        episode_return=0.0, episode_length=steps,
    )  # fmt: skip


def play(learning: OffPolicyLearning, first: int, count: int, place: Path | None = None) -> int:
    """Keep segments and learn from all of them at once; how many updates that was."""
    segments = [segment(seq, place=place) for seq in range(first, first + count)]
    for each in segments:
        learning.keep(each)
    before = learning.updates
    learning.learn(segments, 0.0, is_behind=False)
    return learning.updates - before


def test_updates_follow_the_steps_played(learning: Learn) -> None:
    """One a step after the warm-up, and at most ten steps ahead; twice what was played a round."""
    run = learning()
    assert [play(run, first, 1) for first in range(3)] == [0, 0, 0]
    assert play(run, 3, 1) == 10  # 20 steps: warm, and learning may lead by 10
    assert [play(run, first, 1) for first in range(4, 8)] == [5, 5, 5, 5]
    for seq in range(8, 16):
        run.keep(segment(seq))
    run.learn([segment(seq) for seq in range(8, 16)], 0.0, is_behind=False)
    assert run.updates == 40  # 40 steps came, but actors are to have new weights


def test_updates_are_due_for_steps_that_were_learned_from(learning: Learn) -> None:
    """What has arrived since, as during a round, counts in the next: never more than one a step."""
    run = learning()
    play(run, 0, 4)
    segments = [segment(seq) for seq in range(4, 6)]
    for each in segments:
        run.keep(each)
    before = run.updates
    run.learn(segments[:1], 0.0, is_behind=False)
    assert run.updates - before == 5
    run.learn(segments[1:], 0.0, is_behind=False)
    assert run.updates - before == 10


@pytest.mark.parametrize("prioritised", [False, True])
def test_errors_become_priorities_where_they_count(
    learning: Learn, tmp_path: Path, prioritised: bool
) -> None:
    """New rows have priority 1, rows that were learned from their error."""
    run = learning(prioritised=prioritised)
    play(run, 0, 20)
    (file,) = (tmp_path / "run" / "replay").glob("priority-*.f32")
    priorities = np.fromfile(file, np.float32)[:100]
    assert bool((priorities != 1.0).any()) is prioritised


def test_the_size_of_returns_is_that_of_the_replay(learning: Learn) -> None:
    """Rewards of 1, episodes of 5 steps, a half of what follows: 1.9375, 1.875, 1.75, 1.5, 1."""
    run = learning(batch_rows=900, gamma=0.5)
    segments = [dataclasses.replace(segment(n), reward=np.ones(5, np.float32)) for n in range(20)]
    for each in segments:
        run.keep(each)
    run.learn(segments, 0.0, is_behind=False)
    expected = np.mean(np.square([1.9375, 1.875, 1.75, 1.5, 1.0]))
    found = run.state()[0]["return_size.mean_square"]
    assert float(found) == pytest.approx(expected, abs=0.15)


def test_a_size_that_is_not_wanted_draws_nothing(learning: Learn) -> None:
    """Eight numbers an update, for its rows, and no more."""
    run = learning(norm_return=False)
    updates = play(run, 0, 8)
    expected = np.random.default_rng(np.random.SeedSequence([7, 1]))
    expected.random((updates, 8))
    assert run.state()[1]["rng"] == expected.bit_generator.state


def test_half_an_update_a_step(learning: Learn) -> None:
    run = learning(utd_ratio=0.5, lead_steps=16)
    assert sum(play(run, first, 1) for first in range(24)) == (24 * 5 - 20) // 2 + 8


def test_acts_at_random_until_something_was_learned(learning: Learn) -> None:
    run = learning()
    rng = np.random.default_rng(0)
    obs = np.zeros((2000, 3), np.float32)
    drawn = Suggester(run.graph(1, 0.0, {}))(obs, rng).action
    assert np.abs(drawn).max() <= 1.0
    assert np.quantile(drawn, [0.25, 0.75]) == pytest.approx([-0.5, 0.5], abs=0.05)
    play(run, 0, 4)
    mode = Suggester(run.graph(2, 0.0, {})).metadata
    assert (mode["mode"], mode["K"]) == ("soft", "10")


def test_what_is_kept_is_steadier_than_what_actors_play(learning: Learn) -> None:
    run = learning()
    for first in range(0, 32, 4):
        play(run, first, 4)
    obs = np.random.default_rng(1).standard_normal((5, 3)).astype(np.float32)

    def mean(*, to_keep: bool) -> Any:
        graph = run.graph(1, 0.0, {}, to_keep=to_keep)
        return Suggester(graph, "mean")(obs, np.random.default_rng(0)).action

    before = mean(to_keep=True), mean(to_keep=False)
    play(run, 32, 4)
    after = mean(to_keep=True), mean(to_keep=False)
    steps = [np.abs(new - old).max() for old, new in zip(before, after, strict=True)]
    assert 0.0 < steps[0] < steps[1]


def test_actors_wait_while_learning_is_behind(learning: Learn) -> None:
    """Until the warm-up is over they never do."""
    run = learning()
    for seq in range(5):
        run.keep(segment(seq))
        assert run.hold_s(9.0) == 0.0
    run.keep(segment(5))
    assert run.hold_s(9.0) > 0.0
    run.learn([segment(seq) for seq in range(6)], 0.0, is_behind=False)
    assert run.hold_s(9.0) == 0.0


def test_a_round_waits_for_no_more_steps_than_actors_may_send(learning: Learn) -> None:
    """Those held back deliver little, and more than that would be long in coming."""
    run = learning()
    assert run.quota(num_envs=4) == (20, 5, 0)
    for seq in range(6):
        run.keep(segment(seq))
    assert run.quota(num_envs=4) == (1, 5, 0)
    run.learn([segment(seq) for seq in range(6)], 0.0, is_behind=False)
    assert run.quota(num_envs=1) == (5, 5, 0)
    assert run.quota(num_envs=40) == (15, 5, 0)
    held = []
    for seq in range(6, 11):
        held.append(run.hold_s(0.0) > 0.0)
        run.keep(segment(seq))
    assert held == [False, False, False, False, True]


@pytest.mark.parametrize("steps_behind", [100, 10_000])
def test_no_wait_is_longer_than_a_round(learning: Learn, steps_behind: int) -> None:
    """Learning that is far behind would stand still as well: a round begins with steps played."""
    run = learning()
    segments = [segment(seq) for seq in range(steps_behind // 5)]
    for each in segments:
        run.keep(each)
    begin_s = time.monotonic()
    run.learn(segments, 0.0, is_behind=False)
    assert 0.0 < run.hold_s(9.0) <= time.monotonic() - begin_s


@pytest.mark.parametrize("options", [{}, {"prioritised": True, "replay_rows": 35}], ids=str)
def test_a_resumed_one_goes_on_to_the_bit(
    learning: Learn, tmp_path: Path, options: dict[str, Any]
) -> None:
    """From a copy of its replay and its state; also after rows were evicted."""
    place = tmp_path / "run"
    run = learning(**options)
    play(run, 0, 8, place)
    saved = run.state()
    shutil.copytree(place, tmp_path / "copy")
    play(run, 8, 4)
    again = learning("copy", saved=saved, **options)
    play(again, 8, 4)
    one, two = run.state(), again.state()
    assert one[1] == two[1]
    assert all(np.array_equal(one[0][name], two[0][name]) for name in one[0])


def _saved_after(learned: int, run: OffPolicyLearning, place: Path) -> Saved:
    """The state after so many segments, when twelve have been acknowledged."""
    play(run, 0, learned, place)
    saved = run.state()
    for seq in range(learned, 12):
        run.keep(segment(seq, place=place))
    return saved


def test_what_came_after_the_checkpoint_is_still_there_and_due(
    learning: Learn, tmp_path: Path
) -> None:
    run = learning()
    saved = _saved_after(8, run, tmp_path / "run")
    run.keep(segment(12))  # never written into the ledger, so never acknowledged
    run.close()
    again = learning(saved=saved)
    again.quota(num_envs=4)
    outcome = again.learn([segment(99, steps=20)], 0.0, is_behind=False)
    assert outcome.row["replay_rows"] == 12 * 5
    assert outcome.row["gradient_steps"] == 40  # 60 steps, 20 of warm-up, 10 ahead, 10 were made


def test_observations_that_came_after_the_checkpoint_are_taken_into_account(
    learning: Learn, tmp_path: Path
) -> None:
    """Each once: those of the batches before it are in the state."""
    run = learning()
    saved = _saved_after(3, run, tmp_path / "run")
    run.close()
    again = learning(saved=saved)
    tensors, scalars = again.state()
    obs = np.concatenate([segment(seq).obs for seq in range(12)]).astype(np.float64)
    assert float(tensors["normaliser.count"]) == len(obs)
    np.testing.assert_allclose(tensors["normaliser.mean"], obs.mean(0), rtol=1e-12)
    np.testing.assert_allclose(tensors["normaliser.variance"], obs.var(0), rtol=1e-12)
    assert scalars["learned_from"] == len(obs)


def test_a_state_that_does_not_fit_leaves_the_replay_alone(learning: Learn, tmp_path: Path) -> None:
    place = tmp_path / "run"
    run = learning()
    play(run, 0, 8, place)
    saved = run.state()
    run.close()
    before = sorted((p.name, p.stat().st_size) for p in (place / "replay").iterdir())
    with pytest.raises(RunDirectoryError, match="critics"):
        learning(saved=saved, num_critics=3, replay_rows=10)
    assert sorted((p.name, p.stat().st_size) for p in (place / "replay").iterdir()) == before


def _zero(name: str) -> Callable[[Path], None]:
    def damage(place: Path) -> None:
        file = place / "replay" / name
        file.write_bytes(bytes(file.stat().st_size))

    return damage


def _shorten(name: str) -> Callable[[Path], None]:
    def damage(place: Path) -> None:
        file = place / name
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        _zero("obs-1.f32"), _zero("index-1.log"), _shorten("replay/index-1.log"),
        _shorten("segments.log"), lambda place: (place / "segments.log").unlink(),
    ],
    ids=["rows", "index", "part of the index", "part of the ledger", "ledger"],
)  # fmt: skip
def test_a_replay_that_lacks_what_a_checkpoint_knows_is_damaged_and_left_alone(
    learning: Learn, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    """It is not torn by a kill: a checkpoint writes it to the disk."""
    place = tmp_path / "run"
    run = learning()
    saved = _saved_after(8, run, place)
    run.close()
    damage(place)
    before = {p.name: p.read_bytes() for p in (place / "replay").iterdir()}
    with pytest.raises(
        RunDirectoryError, match="expected at least the 40 of the newest checkpoint"
    ):
        learning(saved=saved)
    assert {p.name: p.read_bytes() for p in (place / "replay").iterdir()} == before


def test_rows_after_the_checkpoint_may_be_torn_and_another_replay_begun(
    learning: Learn, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Both are said."""
    place = tmp_path / "run"
    run = learning()
    saved = _saved_after(8, run, place)
    run.close()
    index = place / "replay" / "index-1.log"
    index.write_bytes(index.read_bytes()[:-1])
    again = learning(saved=saved)
    assert again.state()[1]["learned_from"] == 55
    again.close()
    shutil.move(place / "replay", tmp_path / "moved")
    learning(saved=saved).close()
    assert [record.message for record in caplog.records] == [
        f"replay {place / 'replay'}: cut 1 torn records at its end",
        f"replay {place / 'replay'}: is not there any more, another is begun",
    ]


def test_a_replay_of_another_environment_is_refused(learning: Learn) -> None:
    learning().close()
    with pytest.raises(RunDirectoryError, match=r"Other-v0"):
        learning(env_id="Other-v0")


def test_a_replay_below_one_batch_is_refused(learning: Learn) -> None:
    with pytest.raises(UsageError, match="batch_rows"):
        learning(replay_rows=7)
