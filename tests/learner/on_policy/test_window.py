"""The latest batches."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from on_policy_learners import batch_of

from a2s.learner.on_policy.window import Window, stored_window, window_tensors


@given(sizes=st.lists(st.integers(1, 9), min_size=1, max_size=20), steps=st.integers(1, 20))
def test_it_holds_as_few_of_the_newest_batches_as_are_enough(sizes: list[int], steps: int) -> None:
    """Whole ones, in their order."""
    window = Window(steps)
    ends = torch.tensor(sizes).cumsum(0)[:-1]
    rewards = torch.arange(float(sum(sizes))).tensor_split(ends)
    for reward in rewards:
        window.add(batch_of(reward, [len(reward)], [True]))
    found = window.joined().reward.tolist()
    every = torch.cat(rewards).tolist()
    assert found == every[-len(found) :]
    oldest = window.kept[0][1].num_steps
    assert len(found) >= min(steps, len(every))
    assert len(found) - oldest < steps


def test_joined_segments_stay_apart() -> None:
    """Lengths, ends and what comes after are of each."""
    window = Window(100)
    window.add(batch_of(torch.tensor([1.0, 2.0, 3.0]), [2, 1], [True, False]))
    window.add(batch_of(torch.tensor([4.0]), [1], [True]))
    joined = window.joined()
    assert joined.lengths.tolist() == [2, 1, 1]
    assert joined.terminated.tolist() == [True, False, True]
    assert joined.last.tolist() == [1, 2, 3]


def test_a_stored_window_is_the_same_and_shared_batches_are_stored_once() -> None:
    """The best networks' window overlaps with the present one."""
    window = Window(2)
    for reward in (1.0, 2.0, 3.0):
        window.add(batch_of(torch.tensor([reward]), [1], [True]))
        if reward == 2.0:
            before = window.kept
    tensors = window_tensors(before, window.kept)
    assert {name.split(".")[1] for name in tensors} == {"0", "1", "2"}
    for kept in (before, window.kept):
        numbers = [number for number, _ in kept]
        found = stored_window(tensors, numbers)
        assert [number for number, _ in found] == numbers
        for (_, one), (_, other) in zip(found, kept, strict=True):
            assert torch.equal(one.reward, other.reward)
            assert torch.equal(one.lengths, other.lengths)
