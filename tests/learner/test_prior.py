"""Prior data: the share of a batch, what is normalised by, and whose they are."""

import re
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from segments import segment

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.make import make_off_policy
from a2s.learner.off_policy_trainer import OffPolicyTrainer, draw_batch, draw_returns
from a2s.learner.own_replay import OwnReplay
from a2s.learner.prior import Prior
from a2s.learner.replay import directory
from a2s.learner.replay.replay import Replay
from a2s.learner.run.config import off_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.learner.trainer import Saved
from a2s.protocol.errors import A2SError, RunDirectoryError, UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.messages import Segment

ENV_ID = "Test-v0"
LOW, HIGH = -np.ones(2, np.float32), np.ones(2, np.float32)
SPACES = Spaces(obs_size=3, action_low=LOW, action_high=HIGH)
OWN, PRIOR = 1.0, 7.0  # the observations and rewards of either kind
SMALL: dict[str, Any] = {
    "critic_sizes": "16,16", "policy_sizes": "16,16", "batch_rows": 8, "replay_rows": 1000,
    "warm_up_steps": 20, "send_every_steps": 5, "lead_steps": 10,
}  # fmt: skip


def alike(seq: int, value: float, steps: int = 5) -> Segment:
    """An episode of which every observation and reward is this number."""
    return segment(
        seq, steps, obs_size=3, action_size=2, terminated=True,
        obs=np.full((steps, 3), value, np.float32), final_obs=np.full(3, value, np.float32),
        reward=np.full(steps, value, np.float32),
    )  # fmt: skip


def stored(
    path: Path,
    value: float | None = PRIOR,
    spaces: Spaces = SPACES,
    env_id: str = ENV_ID,
) -> Path:
    """Twenty transitions in a directory; without a value no two are alike."""
    replay = directory.create(path, env_id, spaces, 20)
    for seq in range(4):
        any_numbers = segment(seq, 5, obs_size=3, action_size=2, terminated=True)
        replay.insert(any_numbers if value is None else alike(seq, value))
    replay.close()
    return path


@pytest.fixture(scope="module")
def prior_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Prior data that nobody changes."""
    return stored(tmp_path_factory.mktemp("module") / "prior")


Make = Callable[..., tuple[OffPolicyTrainer, OwnReplay]]


@pytest.fixture
def make(tmp_path: Path, prior_path: Path) -> Make:
    """Make a trainer and its replay in the directory ``place``."""

    def made(
        place: str = "run",
        saved: Saved | None = None,
        prior: Path | str = prior_path,
        share: float = 0.5,
        **options: Any,
    ) -> tuple[OffPolicyTrainer, OwnReplay]:
        path = tmp_path / place
        path.mkdir(exist_ok=True)
        run = RunConfig(
            env=ENV_ID, variant="off-policy", seed=7, prior=str(prior), prior_share=share
        )
        hyper = off_policy("modern", {**SMALL, **options})
        ledger = Ledger(path / "segments.log")
        return make_off_policy(run, SPACES, hyper, path, ledger, {}, LearnerMetrics(), saved)

    return made


def play(made: tuple[OffPolicyTrainer, OwnReplay], first: int, count: int) -> int:
    """Store own episodes and learn from them; how many updates that was."""
    trainer, replay = made
    for seq in range(first, first + count):
        replay.store(0, alike(seq, OWN))
    replay.close_batch()
    before = trainer.updates
    trainer.learn(0.0)
    return trainer.updates - before


def acknowledge(place: Path, count: int) -> None:
    """Tell the ledger of a run of its first segments."""
    ledger = Ledger(place / "segments.log")
    for seq in range(count):
        ledger.record("a", seq, "accepted", 5)
    ledger.close()


def own_rows() -> Replay:
    """Twenty transitions of the run itself."""
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    for seq in range(4):
        replay.insert(alike(seq, OWN))
    return replay


@given(batch_rows=st.integers(2, 300), share=st.floats(0.01, 0.99), seed=st.integers(0, 9))
def test_every_batch_has_exactly_the_share_and_the_generator_decides_which(
    prior_path: Path, batch_rows: int, share: float, seed: int
) -> None:
    """The prior rows come last; a share that is no row, or all of them, is refused."""
    wanted = round(share * batch_rows)
    if wanted in (0, batch_rows):
        with pytest.raises(UsageError, match="expected at least one of either kind"):
            Prior(prior_path, ENV_ID, SPACES, share, batch_rows)
        return
    prior = Prior(prior_path, ENV_ID, SPACES, share, batch_rows)
    hyper = off_policy("modern", {"batch_rows": batch_rows})
    once, again = (
        draw_batch(own_rows(), hyper, np.random.default_rng(seed), prior) for _ in range(2)
    )
    assert once.reward.tolist() == [OWN] * (batch_rows - wanted) + [PRIOR] * wanted
    assert len(once.row) == batch_rows - wanted
    for name in ("obs", "action", "reward", "next_obs", "discount", "weight"):
        assert len(getattr(once, name)) == batch_rows
        assert np.array_equal(getattr(once, name), getattr(again, name))
    returns = draw_returns(own_rows(), hyper, np.random.default_rng(seed), prior)
    assert (returns >= PRIOR).sum() == wanted  # an own return is 5 at most
    prior.close()


@given(
    cuts=st.lists(st.integers(0, 1000), max_size=8), share=st.sampled_from([0.1, 0.25, 0.5, 0.9])
)
def test_observations_are_taken_in_the_proportion_of_a_batch_however_they_arrive(
    prior_path: Path, cuts: list[int], share: float
) -> None:
    prior = Prior(prior_path, ENV_ID, SPACES, share, 20)
    rng, ends = np.random.default_rng(0), [0, *sorted(cuts), 1000]
    counts = [len(prior.obs_beside(a, b, rng)) for a, b in pairwise(ends)]
    assert sum(counts) == 1000 * round(share * 20) // (20 - round(share * 20))
    prior.close()


@pytest.mark.parametrize(
    ("share", "count", "mean", "variance"),
    [
        (0.5, 40, 4.0, 9.0),  # 20 of 1, 20 of 7
        (0.25, 26, 62 / 26, 36 * (6 / 26) * (20 / 26)),  # 2 of 8 rows: 20 * 2 // 6 = 6 of 7
    ],
)
def test_observations_are_normalised_by_what_batches_consist_of(
    make: Make, share: float, count: int, mean: float, variance: float
) -> None:
    """Not by how many there are of either kind."""
    made = make(share=share)
    play(made, 0, 4)
    tensors = made[0].state()[0]
    assert float(tensors["normaliser.count"]) == count
    assert tensors["normaliser.mean"].tolist() == pytest.approx([mean] * 3)
    assert tensors["normaliser.variance"].tolist() == pytest.approx([variance] * 3)


def test_the_size_of_returns_is_that_of_what_batches_consist_of(make: Make) -> None:
    """Of what follows, a thousandth counts: about 1 and 7, so (1 + 49) / 2."""
    made = make(gamma=0.001)
    play(made, 0, 4)
    assert float(made[0].state()[0]["return_size.mean_square"]) == pytest.approx(25.0, rel=0.01)


@pytest.mark.parametrize("prioritised", [False, True])
def test_updates_are_due_for_own_steps_alone(make: Make, prioritised: bool) -> None:
    """As many as without prior data: none before the warm-up, then one a step, 10 ahead."""
    made = make(prioritised=prioritised)
    assert [play(made, first, 1) for first in range(6)] == [0, 0, 0, 10, 5, 5]


def test_the_same_is_learned_from_the_same_and_another_thing_without(make: Make) -> None:
    found = []
    for place, prior in (("one", None), ("two", None), ("without", "")):
        made = make(place) if prior is None else make(place, prior=prior)
        for first in range(0, 8, 2):
            play(made, first, 2)
        found.append(made[0].state()[0]["critics"])
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


@pytest.mark.parametrize(
    "options", [{}, {"prioritised": True, "replay_rows": 35}, {"n_step": 3}], ids=str
)
def test_a_resumed_run_goes_on_to_the_bit(
    make: Make, tmp_path: Path, options: dict[str, Any]
) -> None:
    """Also where the prior data have been moved."""
    path = stored(tmp_path / "prior", None)
    made = make(prior=path, **options)
    acknowledge(tmp_path / "run", 12)
    play(made, 0, 8)
    saved = made[0].state()
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    play(made, 8, 4)
    moved = shutil.copytree(path, tmp_path / "moved")
    again = make("copy", saved=saved, prior=moved, **options)
    play(again, 8, 4)
    one, two = made[0].state(), again[0].state()
    assert one[1] == two[1]
    assert all(torch.equal(one[0][name], two[0][name]) for name in one[0])


def test_a_run_goes_on_with_its_own_prior_data_only(
    make: Make, tmp_path: Path, prior_path: Path
) -> None:
    """One line says what is wrong, and nothing is changed."""
    identity = Prior(prior_path, ENV_ID, SPACES, 0.5, 8).identity
    other = stored(tmp_path / "other", value=8.0)
    with_prior, without = make("with"), make("without", prior="")
    for made in (with_prior, without):
        play(made, 0, 4)
        made[0].close()
    saved, bare = (made[0].state() for made in (with_prior, without))
    before = {path: path.read_bytes() for path in (tmp_path / "with" / "replay").iterdir()}
    for state, place, prior, said in (
        (saved, "with", other, rf"found [0-9a-f]{{16}}, expected {identity}, as the run began"),
        (saved, "with", "", rf"found none, expected {identity}, as the run began with"),
        (saved, "with", tmp_path / "gone", r"gone: found no replay.json there.*with --prior"),
        (bare, "without", prior_path, rf"found {identity}, expected none, as the run began with"),
    ):
        with pytest.raises(RunDirectoryError, match=said):
            make(place, saved=state, prior=prior)
    assert {p: p.read_bytes() for p in (tmp_path / "with" / "replay").iterdir()} == before
    acknowledge(tmp_path / "with", 4)
    make("with", saved=saved)[0].close()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"env_id": "Other-v0"}, "found environment Other-v0, expected Test-v0; name other prior"),
        (
            {"spaces": Spaces(obs_size=3, action_low=LOW, action_high=2 * HIGH)},
            "found action_high [2.0, 2.0], expected [1.0, 1.0]; name other prior data",
        ),
        (
            {
                "spaces": Spaces(
                    obs_size=3, action_low=LOW, action_high=HIGH, obs_offset=np.ones(3, np.float32)
                )
            },
            "found observations less [1.0, 1.0, 1.0], expected less 0; name other prior data",
        ),
    ],
)
def test_prior_data_of_another_environment_are_one_line(
    make: Make, tmp_path: Path, fields: dict[str, Any], said: str
) -> None:
    """And may be written to afterwards."""
    path = stored(tmp_path / "prior", **fields)
    with pytest.raises(RunDirectoryError, match=re.escape(said)) as caught:
        make(prior=path)
    assert "\n" not in str(caught.value)
    directory.open_existing(path).close()


def test_several_runs_may_draw_from_one_and_none_write_to_it(make: Make, tmp_path: Path) -> None:
    path = stored(tmp_path / "prior")
    one, two = make("one", prior=path), make("two", prior=path)
    with pytest.raises(A2SError, match="learns from it"):
        directory.open_existing(path)
    for made in (one, two):
        made[0].close()
    directory.open_existing(path).close()
