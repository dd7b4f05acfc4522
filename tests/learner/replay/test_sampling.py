"""What is sampled, against values worked out by hand and against a slow and obvious list."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from replay_oracle import ENV_ID, SPACES, Oracle, make_segment

from a2s.learner.replay import directory
from a2s.learner.replay.replay import Replay
from a2s.protocol.errors import MalformedMessageError, UsageError
from a2s.protocol.fields import Spaces

PLAYED = st.lists(
    st.tuples(
        st.sampled_from([("a", 0), ("a", 1), ("b", 0)]),
        st.integers(1, 6),
        st.sampled_from(["", "", "terminated", "truncated"]),
        st.booleans(),
    ),
    max_size=30,
)


def targets(replay: Replay, n_step: int, gamma: float) -> dict[int, tuple[float, float, float]]:
    """Sample until every row has surely come, and give what each goes to."""
    rng = np.random.default_rng(1)
    batch = replay.sample(40 * len(replay), rng, n_step=n_step, gamma=gamma)
    assert np.array_equal(batch.obs[:, 0], -batch.obs[:, 1])
    assert np.array_equal(batch.action, batch.obs / 2)
    assert (batch.weight == 1.0).all()
    return {
        int(row): (float(reward), float(next_obs), float(discount))
        for row, reward, next_obs, discount in zip(
            batch.row, batch.reward, batch.next_obs[:, 0], batch.discount, strict=True
        )
    }


def assert_equals(replay: Replay, oracle: Oracle, n_step: int, gamma: float = 0.9) -> None:
    """Hold every row that can be sampled to the oracle, and none may be missing."""
    live = oracle.live()
    assert (replay.live, replay.live.stop, len(replay)) == (live, live.stop, len(live))
    if not live:
        return
    found = targets(replay, n_step, gamma)
    assert set(found) <= set(live)
    assert len(found) > 0.9 * len(live)
    for row, values in found.items():
        assert values == pytest.approx(oracle.target(row, n_step, gamma), rel=1e-5), row


@pytest.mark.parametrize(
    ("end", "n_step", "expected"),
    [
        # rewards 1, 2, 4; observations 10, 11, 12, 13; gamma 1/2
        ("", 1, [(1.0, 11.0, 0.5), (2.0, 12.0, 0.5), (4.0, 13.0, 0.5)]),
        ("", 2, [(2.0, 12.0, 0.25), (4.0, 13.0, 0.25), (4.0, 13.0, 0.5)]),
        ("", 3, [(3.0, 13.0, 0.125), (4.0, 13.0, 0.25), (4.0, 13.0, 0.5)]),
        ("truncated", 3, [(3.0, 13.0, 0.125), (4.0, 13.0, 0.25), (4.0, 13.0, 0.5)]),
        ("terminated", 1, [(1.0, 11.0, 0.5), (2.0, 12.0, 0.5), (4.0, 13.0, 0.0)]),
        ("terminated", 2, [(2.0, 12.0, 0.25), (4.0, 13.0, 0.0), (4.0, 13.0, 0.0)]),
        ("terminated", 9, [(3.0, 13.0, 0.0), (4.0, 13.0, 0.0), (4.0, 13.0, 0.0)]),
    ],
)
@pytest.mark.parametrize("cuts", [[], [1], [2], [1, 2]])
def test_n_steps_end_with_the_episode_however_it_was_cut(
    end: str, n_step: int, expected: list[tuple[float, float, float]], cuts: list[int]
) -> None:
    """Termination bootstraps nothing, truncation and the newest step do; segments are invisible."""
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    obs, reward = [10.0, 11.0, 12.0, 13.0], [1.0, 2.0, 4.0]
    where: list[int] = []
    for begin, stop in zip([0, *cuts], [*cuts, 3], strict=True):
        segment = make_segment(
            obs[begin : stop + 1], reward[begin:stop], before=begin, end=end if stop == 3 else ""
        )
        where += replay.insert(segment)
        # Another stream comes in between.
        replay.insert(make_segment([70.0, 71.0], [8.0], actor="b", before=begin))
    found = targets(replay, n_step, 0.5)
    assert [found[row] for row in where] == expected


@pytest.mark.parametrize(
    ("before", "first_obs", "linked"),
    [(2, 12.0, True), (3, 12.0, False), (2, 12.5, False)],
)
def test_only_the_very_next_step_of_the_same_episode_follows(
    before: int, first_obs: float, linked: bool
) -> None:
    """With segments lost between, another episode may seem to go on by its length alone."""
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    replay.insert(make_segment([10.0, 11.0, 12.0], [1.0, 2.0]))
    replay.insert(make_segment([first_obs, 20.0], [4.0], before=before, seq=1))
    assert targets(replay, 2, 0.5)[1] == ((4.0, 20.0, 0.25) if linked else (2.0, 12.0, 0.5))


@settings(deadline=None)
@given(
    played=PLAYED,
    capacity=st.integers(1, 25),
    again=st.integers(1, 25),
    n_step=st.integers(1, 5),
)
def test_every_row_is_that_of_the_oracle_in_memory_and_opened_again(
    tmp_path_factory: pytest.TempPathFactory,
    played: list[tuple[tuple[str, int], int, str, bool]],
    capacity: int,
    again: int,
    n_step: int,
) -> None:
    """Eviction, ends, links and n-step returns, with segments lost; another capacity as well."""
    path = tmp_path_factory.mktemp("replay")
    oracle = Oracle(capacity)
    replay = directory.create(path, ENV_ID, SPACES, capacity)
    in_memory = Replay.in_memory(ENV_ID, SPACES, capacity)
    for i, ((actor, env), steps, end, lost) in enumerate(played):
        segment = oracle.play(actor, env, steps, end, lost=lost)
        if not lost:
            rows = range(len(oracle.steps) - steps, len(oracle.steps))
            assert replay.insert(segment) == in_memory.insert(segment) == rows
        if i == len(played) // 2:
            replay.close()
            replay = directory.open_existing(path, env_id=ENV_ID, spaces=SPACES)
            assert_equals(replay, oracle, n_step)
    replay.close()
    assert_equals(in_memory, oracle, n_step)
    assert_equals(directory.look_at(path), oracle, n_step)
    replay = directory.open_existing(path, capacity=again)
    oracle.capacity = min(capacity, again)
    assert_equals(replay, oracle, n_step)
    replay.close()
    assert_equals(directory.look_at(path), oracle, n_step)


def test_a_segment_longer_than_the_capacity_leaves_its_newest_steps(tmp_path: Path) -> None:
    """Long ones are written in pieces, which nobody sees."""
    oracle = Oracle(10_000)
    replay = directory.create(tmp_path, ENV_ID, SPACES, 10_000)
    for steps in (9_000, 25_000, 7_000):
        replay.insert(oracle.play("a", 0, steps, "", lost=False))
    assert_equals(replay, oracle, 3)
    replay.close()
    assert_equals(directory.look_at(tmp_path), oracle, 3)
    oracle.capacity = 6_000
    replay = directory.open_existing(tmp_path, capacity=6_000)
    assert_equals(replay, oracle, 3)
    replay.close()


@pytest.mark.parametrize("prioritised", [False, True])
def test_the_same_generator_draws_the_same(prioritised: bool) -> None:
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    replay.insert(make_segment([float(i) for i in range(51)], [1.0] * 50))
    first, again, other = (
        replay.sample(32, np.random.default_rng(seed), prioritised=prioritised).row.tolist()
        for seed in (5, 5, 6)
    )
    assert first == again != other


def test_what_cannot_be_sampled_or_inserted_is_refused(rng: np.random.Generator) -> None:
    """By one line."""
    replay = Replay.in_memory(ENV_ID, SPACES, 100)
    with pytest.raises(UsageError, match="found no transition to sample"):
        replay.sample(1, rng)
    replay.insert(make_segment([1.0, 2.0], [1.0]))
    with pytest.raises(UsageError, match="found batch of 0"):
        replay.sample(0, rng)
    with pytest.raises(UsageError, match="n_step 0"):
        replay.sample(1, rng, n_step=0)
    with pytest.raises(UsageError, match="negative or non-finite"):
        replay.update_priorities(np.array([0]), np.array([-1.0]))
    zeros = np.zeros(1, np.float32)
    wide = Spaces(obs_size=3, action_low=zeros, action_high=zeros + 1)
    with pytest.raises(MalformedMessageError, match=r"found obs_size and action_size \(2, 2\)"):
        Replay.in_memory(ENV_ID, wide, 100).insert(make_segment([1.0, 2.0], [1.0]))


def test_no_one_sees_a_segment_that_is_half_inserted() -> None:
    """Its pieces evict one another, so a reader between two of them would see other numbers."""
    replay = Replay.in_memory(ENV_ID, SPACES, 4)
    segment = make_segment([float(i) for i in range(401)], [1.0] * 400)

    def learn() -> None:
        for _ in range(500):
            replay.insert(segment)

    with ThreadPoolExecutor(1) as pool:
        learning = pool.submit(learn)
        while not learning.done():
            live = replay.live
            assert len(live) in {0, 4}
            assert live.stop % 400 == 0
        learning.result(timeout=10)
