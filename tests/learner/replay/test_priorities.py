"""Prioritised draws: in proportion, made up for by weights, and never of what is gone."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from replay_oracle import ENV_ID, SPACES, make_segment

from a2s.learner.replay import directory
from a2s.learner.replay.replay import Replay
from a2s.learner.replay.ring import Floats
from a2s.learner.replay.sum_tree import SumTree


def filled(replay: Replay, steps: int) -> Replay:
    """Insert one segment."""
    replay.insert(make_segment([float(i) for i in range(steps + 1)], [1.0] * steps))
    return replay


@pytest.mark.parametrize("size", [1, 16, 17, 1024, 1025, 20_000, 300_000])
def test_leaves_are_drawn_in_proportion(size: int, rng: np.random.Generator) -> None:
    """At every depth of the tree: from each tenth of it, and from each place within a node."""
    leaves = rng.random(size, dtype=np.float32) ** 4
    leaves[rng.random(size) < 0.3] = 0.0
    leaves[0] = 0.5
    tree = SumTree(leaves)
    drawn = np.concatenate([tree.draw(1000, rng) for _ in range(100)])
    assert (leaves[drawn] > 0).all()
    place = np.arange(size)
    for group in (place * 10 // size, place % 16, place // 16 % 16):
        share = np.bincount(group, weights=leaves, minlength=16) / leaves.sum(dtype=np.float64)
        found = np.bincount(group[drawn], minlength=16) / len(drawn)
        assert found == pytest.approx(share, abs=0.006)  # four standard deviations, at most


class AtTheEnd(np.random.Generator):
    """Always says the largest number that it can."""

    def random(self, size: int) -> Floats:  # type: ignore[override]
        """As its base, but not at random."""
        return np.full(size, np.nextafter(1.0, 0.0))


@pytest.mark.parametrize("empty", range(1, 16))
@pytest.mark.parametrize("shares", [1, 7, 64])
def test_a_leaf_of_zero_is_not_drawn_where_sums_were_rounded_up(empty: int, shares: int) -> None:
    """At the end of a share, with nothing behind it in a node, or in the node above."""
    end = AtTheEnd(np.random.PCG64())
    place = np.arange(4096)
    for within in (place % 16, place // 16 % 16, place // 256):
        for seed in range(20):
            leaves = np.random.default_rng(seed).random(4096, dtype=np.float32)
            leaves[within >= 16 - empty] = 0.0
            assert (leaves[SumTree(leaves).draw(shares, end)] > 0).all()


@settings(deadline=None)
@given(
    size=st.integers(1, 3000),
    sets=st.lists(
        st.tuples(st.integers(0, 10**9), st.integers(0, 40), st.floats(0, 9)), max_size=9
    ),
)
def test_a_tree_depends_on_its_leaves_only(size: int, sets: list[tuple[int, int, float]]) -> None:
    """Set one by one or by ranges, it draws like one made anew; the last value of a leaf counts."""
    expected = np.linspace(0.0, 1.0, size, dtype=np.float32)
    tree = SumTree(expected)
    for seed, count, value in sets:
        rng = np.random.default_rng(seed)
        begin = int(rng.integers(size))
        end = min(size, begin + count)
        tree.assign_range(begin, end, value)
        expected[begin:end] = value
        leaf, values = rng.integers(0, size, count), rng.random(count, dtype=np.float32)
        tree.assign(leaf, values)
        for where, what in zip(leaf, values, strict=True):
            expected[where] = what
        assert np.array_equal(tree.leaves[:size], expected)
        if expected.sum() > 0:
            drawn = tree.draw(64, np.random.default_rng(seed))
            made_anew = SumTree(expected).draw(64, np.random.default_rng(seed))
            assert np.array_equal(drawn, made_anew)
            assert (expected[drawn] > 0).all()


def test_rows_are_drawn_as_often_as_their_priority_says(rng: np.random.Generator) -> None:
    """Chance p^alpha / sum, weight (N chance)^-beta over the highest (the paper, 3.3 and 3.4)."""
    replay = filled(Replay.in_memory(ENV_ID, SPACES, 100, alpha=0.5), 4)
    replay.update_priorities(np.arange(4), np.array([0.0, 1.0, 4.0, 25.0]))
    chance = np.array([0.001, 1.0, 2.0, 5.0]) / 8.001  # the square roots, 1e-6 added before
    count = np.zeros(4)
    for _ in range(100):
        batch = replay.sample(1000, rng, prioritised=True, beta=0.5)
        count += np.bincount(batch.row, minlength=4)
        weight = (4 * chance) ** -0.5
        expected = weight[batch.row] / weight[batch.row].max()
        assert batch.weight == pytest.approx(expected, rel=1e-3)
    assert count / count.sum() == pytest.approx(chance, abs=1e-3)


def test_new_rows_are_drawn_like_the_most_important(rng: np.random.Generator) -> None:
    """They have not been looked at yet."""
    replay = filled(Replay.in_memory(ENV_ID, SPACES, 100, alpha=1.0), 3)
    replay.sample(1, rng, prioritised=True)
    replay.update_priorities(np.array([0, 1, 2]), np.array([9.0, 1.0, 1.0]))
    replay.insert(make_segment([5.0, 6.0], [1.0], seq=1))
    row = replay.sample(20_000, rng, prioritised=True).row
    assert np.bincount(row) / len(row) == pytest.approx([0.45, 0.05, 0.05, 0.45], abs=0.01)


def test_evicted_rows_are_never_drawn(rng: np.random.Generator) -> None:
    """However high their priority was; a late update of it changes nothing."""
    replay = Replay.in_memory(ENV_ID, SPACES, 10)
    for i in range(40):
        steps = 1 + i % 7
        replay.insert(make_segment([float(i)] * (steps + 1), [1.0] * steps, seq=i))
        row = replay.sample(200, rng, prioritised=True).row
        live = set(replay.live)
        assert set(row.tolist()) <= live
        assert i % 10 or set(row.tolist()) == live
        replay.update_priorities(np.arange(replay.live.stop), np.full(replay.live.stop, 1000.0))


def test_priorities_survive(tmp_path: Path) -> None:
    """A resumed run draws what it would have drawn."""
    replay = filled(directory.create(tmp_path, ENV_ID, SPACES, 100), 70)
    replay.update_priorities(np.arange(70), np.linspace(0.0, 1.0, 70))
    drawn = replay.sample(256, np.random.default_rng(3), prioritised=True)
    replay.close()
    for capacity in (100, 90):
        replay = directory.open_existing(tmp_path, capacity=capacity)
        again = replay.sample(256, np.random.default_rng(3), prioritised=True)
        replay.close()
        assert np.array_equal(again.row, drawn.row)
        assert np.array_equal(again.weight, drawn.weight)
