"""The off-policy trainer and its replay: how much is learned, from what, when to wait."""

import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from segments import segment

from a2s.actors.suggester import Suggester
from a2s.learner.ingest.ledger import Ledger
from a2s.learner.make import make_off_policy
from a2s.learner.off_policy_trainer import OffPolicyTrainer
from a2s.learner.own_replay import OwnReplay
from a2s.learner.run.config import off_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.learner.trainer import Outcome, Saved
from a2s.protocol.errors import RunDirectoryError, UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Segment

SPACES = Spaces(obs_size=3, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))
SMALL: dict[str, Any] = {
    "critic_sizes": "16,16", "policy_sizes": "16,16", "batch_rows": 8, "replay_rows": 1000,
    "warm_up_steps": 20, "send_every_steps": 5, "lead_steps": 10,
}  # fmt: skip


class _Run(NamedTuple):
    """A trainer and its replay."""

    trainer: OffPolicyTrainer
    replay: OwnReplay

    def store(self, numbers: Iterable[int], place: Path | None = None) -> None:
        """Store segments with these numbers."""
        for seq in numbers:
            self.replay.store(0, played(seq, place))

    def learn(self) -> Outcome:
        """Learn from what was stored."""
        self.replay.close_batch()
        return self.trainer.learn(0.0)

    def play(self, first: int, count: int, place: Path | None = None) -> int:
        """Store segments and learn from all of them at once; how many updates that was."""
        self.store(range(first, first + count), place)
        before = self.trainer.updates
        self.learn()
        return self.trainer.updates - before


Learn = Callable[..., _Run]


@pytest.fixture
def make(tmp_path: Path) -> Learn:
    """Make one, in the directory ``place``."""

    def made(
        place: str = "run",
        env_id: str = "Test-v0",
        saved: Saved | None = None,
        *,
        again: bool = False,
        **options: Any,
    ) -> _Run:
        path = tmp_path / place
        path.mkdir(exist_ok=True)
        ledger = Ledger(path / "segments.log")
        hyper = off_policy("modern", {**SMALL, **options})
        run = RunConfig(env=env_id, variant="off-policy", seed=7)
        return _Run(
            *make_off_policy(
                run, SPACES, hyper, path, ledger, {}, LearnerMetrics(), saved, again=again
            )
        )

    return made


def played(seq: int, place: Path | None = None) -> Segment:
    """An episode of five steps; told to the ledger of ``place``."""
    if place is not None:
        ledger = Ledger(place / "segments.log")
        ledger.record("a", seq, "accepted", 5)
        ledger.close()
    return segment(seq, 5, obs_size=3, action_size=2, terminated=True)


def test_updates_follow_the_steps_played(make: Learn) -> None:
    """One a step after the warm-up, and at most ten steps ahead; twice what was played a round."""
    run = make()
    assert [run.play(first, 1) for first in range(3)] == [0, 0, 0]
    assert run.play(3, 1) == 10  # 20 steps: warm, and learning may lead by 10
    assert [run.play(first, 1) for first in range(4, 8)] == [5, 5, 5, 5]
    run.store(range(8, 16))
    run.learn()
    assert run.trainer.updates == 40  # 40 steps came, but actors are to have new weights


@pytest.mark.parametrize(("every", "learned"), [(1, 15), (2, 7), (4, 3)])
def test_the_policy_learns_in_every_so_many_updates(
    make: Learn, tmp_path: Path, every: int, learned: int
) -> None:
    """Counted over rounds of ten and five, and over a resume between them."""
    run = make(policy_every=every)
    run.play(0, 4, tmp_path / "run")
    saved = run.trainer.state()
    run.trainer.close()
    again = make(policy_every=every, saved=saved)
    again.play(4, 1)
    tensors, numbers = again.trainer.state()
    assert numbers["updates"] == float(tensors["adam.critics.steps"]) == 15
    assert float(tensors["adam.policy.steps"]) == learned


def test_updates_are_due_for_the_steps_of_a_batch(make: Learn) -> None:
    """What is stored since, as during a round, counts in the next: never more than one a step."""
    run = make()
    run.play(0, 4)
    before = run.trainer.updates
    run.store([4])
    run.replay.close_batch()
    run.store([5])
    run.trainer.learn(0.0)
    assert run.trainer.updates - before == 5
    run.learn()
    assert run.trainer.updates - before == 10


@pytest.mark.parametrize("prioritised", [False, True])
def test_errors_become_priorities_where_they_count(
    make: Learn, tmp_path: Path, prioritised: bool
) -> None:
    """New rows have priority 1, rows that were learned from their error."""
    run = make(prioritised=prioritised)
    run.play(0, 20)
    (file,) = (tmp_path / "run" / "replay").glob("priority-*.f32")
    priorities = np.fromfile(file, np.float32)[:100]
    assert bool((priorities != 1.0).any()) is prioritised


def test_the_size_of_returns_is_that_of_the_replay(make: Learn) -> None:
    """Rewards of 1, episodes of 5 steps, a half of what follows: 1.9375, 1.875, 1.75, 1.5, 1."""
    run = make(batch_rows=900, gamma=0.5)
    run.play(0, 20)
    expected = np.mean(np.square([1.9375, 1.875, 1.75, 1.5, 1.0]))
    found = run.trainer.state()[0]["return_size.mean_square"]
    assert float(found) == pytest.approx(expected, abs=0.15)


def test_a_size_that_is_not_wanted_draws_nothing(make: Learn) -> None:
    """Eight numbers an update, for its rows, and no more."""
    run = make(norm_return=False)
    updates = run.play(0, 8)
    expected = np.random.default_rng(np.random.SeedSequence([7, 1]))
    expected.random((updates, 8))
    assert run.trainer.state()[1]["rng"] == expected.bit_generator.state


def test_half_an_update_a_step(make: Learn) -> None:
    run = make(utd_ratio=0.5, lead_steps=16)
    assert sum(run.play(first, 1) for first in range(24)) == (24 * 5 - 20) // 2 + 8


def test_acts_at_random_until_something_was_learned(make: Learn) -> None:
    run = make()
    rng = np.random.default_rng(0)
    obs = np.zeros((2000, 3), np.float32)
    drawn = Suggester(run.trainer.graph(1, 0.0))(obs, rng).action
    assert np.abs(drawn).max() <= 1.0
    assert np.quantile(drawn, [0.25, 0.75]) == pytest.approx([-0.5, 0.5], abs=0.05)
    run.play(0, 4)
    mode = Suggester(run.trainer.graph(2, 0.0)).metadata
    assert (mode["mode"], mode["K"]) == ("soft", "10")


def test_what_is_kept_is_steadier_than_what_actors_play(make: Learn) -> None:
    run = make()
    for first in range(0, 32, 4):
        run.play(first, 4)
    obs = np.random.default_rng(1).standard_normal((5, 3)).astype(np.float32)

    def mean(*, averaged: bool) -> Any:
        graph = run.trainer.graph(1, 0.0, averaged=averaged)
        return Suggester(graph, "mean")(obs, np.random.default_rng(0)).action

    before = mean(averaged=True), mean(averaged=False)
    run.play(32, 4)
    after = mean(averaged=True), mean(averaged=False)
    steps = [np.abs(new - old).max() for old, new in zip(before, after, strict=True)]
    assert 0.0 < steps[0] < steps[1]


def test_actors_wait_while_learning_is_behind(make: Learn) -> None:
    """Until the warm-up is over they never do."""
    run = make()
    for seq in range(5):
        run.store([seq])
        assert run.replay.hold_s(9.0) == 0.0
    run.store([5])
    assert run.replay.hold_s(9.0) > 0.0
    run.learn()
    assert run.replay.hold_s(9.0) == 0.0


def test_a_round_waits_for_no_more_steps_than_actors_may_send(make: Learn) -> None:
    """Those held back deliver little, and more than that would be long in coming."""
    run = make()
    assert run.replay.quota(num_envs=4) == (20, 5, 0)
    run.store(range(6))
    assert run.replay.quota(num_envs=4) == (1, 5, 0)
    run.learn()
    assert run.replay.quota(num_envs=1) == (5, 5, 0)
    assert run.replay.quota(num_envs=40) == (15, 5, 0)
    held = []
    for seq in range(6, 11):
        held.append(run.replay.hold_s(0.0) > 0.0)
        run.store([seq])
    assert held == [False, False, False, False, True]


@pytest.mark.parametrize("steps_behind", [100, 10_000])
def test_no_wait_is_longer_than_a_round(make: Learn, steps_behind: int) -> None:
    """Learning that is far behind would stand still as well: a round begins with steps played."""
    run = make()
    run.store(range(steps_behind // 5))
    begin_s = time.monotonic()
    run.learn()
    assert 0.0 < run.replay.hold_s(9.0) <= time.monotonic() - begin_s


@pytest.mark.parametrize("options", [{}, {"prioritised": True, "replay_rows": 35}], ids=str)
def test_a_resumed_one_goes_on_to_the_bit(
    make: Learn, tmp_path: Path, options: dict[str, Any]
) -> None:
    """From a copy of its replay and its state; also after rows were evicted."""
    place = tmp_path / "run"
    run = make(**options)
    run.play(0, 8, place)
    saved = run.trainer.state()
    shutil.copytree(place, tmp_path / "copy")
    run.play(8, 4)
    again = make("copy", saved=saved, **options)
    again.play(8, 4)
    one, two = run.trainer.state(), again.trainer.state()
    assert one[1] == two[1]
    assert all(np.array_equal(one[0][name], two[0][name]) for name in one[0])


def _saved_after(learned: int, run: _Run, place: Path) -> Saved:
    """The state after so many segments, when twelve have been acknowledged."""
    run.play(0, learned, place)
    saved = run.trainer.state()
    run.store(range(learned, 12), place)
    return saved


def test_what_came_after_the_checkpoint_belongs_to_the_next_batch(
    make: Learn, tmp_path: Path
) -> None:
    """Each observation counts once: those of the batches before it are in the state."""
    run = make()
    saved = _saved_after(8, run, tmp_path / "run")
    run.store([12])  # never written into the ledger, so never acknowledged
    run.trainer.close()
    again = make(saved=saved)
    again.replay.quota(num_envs=4)
    row = again.learn().row
    # 60 steps, 20 of warm-up, 10 ahead, 10 were made
    assert (row["replay_rows"], row["gradient_steps"]) == (60, 40)
    tensors, scalars = again.trainer.state()
    obs = np.concatenate([played(seq).obs for seq in range(12)]).astype(np.float64)
    assert float(tensors["normaliser.count"]) == scalars["learned_from"] == len(obs)
    np.testing.assert_allclose(tensors["normaliser.mean"], obs.mean(0), rtol=1e-12)
    np.testing.assert_allclose(tensors["normaliser.variance"], obs.var(0), rtol=1e-12)


def test_what_came_with_the_end_of_a_run_is_learned_from_by_who_goes_on(
    make: Learn, tmp_path: Path
) -> None:
    """It was closed as a batch without learning; what comes again is what came after that."""
    run = make()
    run.play(0, 8, tmp_path / "run")
    run.store([8, 9], tmp_path / "run")
    run.replay.close_batch()
    saved = run.trainer.state()
    run.store([10], tmp_path / "run")
    run.trainer.close()
    again = make(saved=saved, again=True)
    assert len(again.replay.replay) == 50
    again.play(10, 1)
    assert again.trainer.state()[1]["learned_from"] == 55


def test_a_state_that_does_not_fit_leaves_the_replay_alone(make: Learn, tmp_path: Path) -> None:
    place = tmp_path / "run"
    run = make()
    run.play(0, 8, place)
    saved = run.trainer.state()
    run.trainer.close()
    before = sorted((p.name, p.stat().st_size) for p in (place / "replay").iterdir())
    with pytest.raises(RunDirectoryError, match="critics"):
        make(saved=saved, num_critics=3, replay_rows=10)
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
    make: Learn, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    """It is not torn by a kill: a checkpoint writes it to the disk."""
    place = tmp_path / "run"
    run = make()
    saved = _saved_after(8, run, place)
    run.trainer.close()
    ledger = (place / "segments.log").read_bytes()
    damage(place)
    before = {p.name: p.read_bytes() for p in (place / "replay").iterdir()}
    with pytest.raises(
        RunDirectoryError, match="expected at least the 40 of the newest checkpoint"
    ) as caught:
        make(saved=saved)
    is_whole = (place / "segments.log").exists() and (place / "segments.log").read_bytes() == ledger
    assert ("; segments.log does not know " in str(caught.value)) != is_whole
    assert {p.name: p.read_bytes() for p in (place / "replay").iterdir()} == before


def test_rows_after_the_checkpoint_may_be_torn_which_is_said(
    make: Learn, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "run"
    run = make()
    saved = _saved_after(8, run, place)
    run.trainer.close()
    index = place / "replay" / "index-1.log"
    index.write_bytes(index.read_bytes()[:-1])
    again = make(saved=saved)
    again.learn()
    assert again.trainer.state()[1]["learned_from"] == 55
    assert [record.message for record in caplog.records] == [
        f"replay {place / 'replay'}: cut 1 torn records at its end"
    ]


def test_a_replay_that_is_gone_is_not_begun_anew(make: Learn, tmp_path: Path) -> None:
    """What was learned from it would be learned from no more; another run can begin from here."""
    place = tmp_path / "run"
    run = make()
    saved = _saved_after(8, run, place)
    run.trainer.close()
    shutil.move(place / "replay", tmp_path / "moved")
    with pytest.raises(RunDirectoryError, match="not there any more; restore it, or begin another"):
        make(saved=saved)
    assert not (place / "replay").exists()


def test_a_replay_of_another_environment_or_below_one_batch_is_refused(make: Learn) -> None:
    make().trainer.close()
    with pytest.raises(RunDirectoryError, match=r"Other-v0"):
        make(env_id="Other-v0")
    with pytest.raises(UsageError, match="batch_rows"):
        make(replay_rows=7)
