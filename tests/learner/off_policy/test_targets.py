"""The target of equations 7 and 8."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from a2s.learner.off_policy.targets import backup, evaluate, log_advantage, pick_best


@pytest.mark.parametrize(
    ("suggestions", "expected"),
    [(1, 0.0), (2, 0.1931), (4, 0.6363), (10, 1.4026), (20, 2.0457)],
)
def test_log_advantage_by_hand(suggestions: int, expected: float) -> None:
    """Zero, ln 2 - 1/2, ln 4 - 3/4, ln 10 - 9/10, ln 20 - 19/20."""
    assert log_advantage(suggestions) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("suggestions", [2, 4, 10])
def test_log_advantage_is_the_mean_log_ratio_of_densities(suggestions: int) -> None:
    """The best of K uniform scores has the density K x^(K - 1)."""
    draw = torch.rand(200_000, suggestions, generator=torch.Generator().manual_seed(0))
    ratio = math.log(suggestions) + (suggestions - 1) * draw.amax(1).log()
    assert float(ratio.mean()) == pytest.approx(log_advantage(suggestions), abs=0.01)


def test_the_selector_picks_and_the_others_evaluate() -> None:
    """The one that the selector likes, though the evaluators think least of it."""
    selector = torch.tensor([[1.0, 9.0, 3.0]])
    action = torch.tensor([[[10.0], [20.0], [30.0]]])
    noise = torch.tensor([[[1.0], [2.0], [3.0]]])
    assert [each.tolist() for each in pick_best(selector, action, noise)] == [[[20.0]], [[2.0]]]


def test_among_equals_the_first_is_picked() -> None:
    """Ties go to the lowest index."""
    (found,) = pick_best(torch.zeros(2, 3), torch.arange(6.0).view(2, 3, 1))
    assert found.flatten().tolist() == [0.0, 3.0]


def test_plain_critics_are_evaluated_by_their_minimum() -> None:
    """State by state."""
    q_value = torch.tensor([[[1.0], [5.0]], [[2.0], [4.0]], [[3.0], [9.0]]])
    assert evaluate(q_value, 0).flatten().tolist() == [1.0, 4.0]


@pytest.mark.parametrize(
    ("dropped", "expected"), [(0, [1.0, 2, 3, 4, 8, 9]), (1, [1.0, 2, 3, 4]), (2, [1.0, 2])]
)
def test_largest_atoms_of_all_are_dropped(dropped: int, expected: list[float]) -> None:
    """Two critics of three atoms; both of the dropped may come from one."""
    q_value = torch.tensor([[[3.0, 1.0, 2.0]], [[9.0, 8.0, 4.0]]])
    assert evaluate(q_value, dropped).tolist() == [expected]


def one_target(discount: float, temperature: float = 0.5, suggestions: int = 4) -> float:
    """Reward 1; two groups worth 10 and 20 with log densities -1 and -3."""
    return float(
        backup(
            torch.tensor([1.0]),
            torch.tensor([discount]),
            torch.tensor([[[10.0]], [[20.0]]]),
            torch.tensor([[-1.0], [-3.0]]),
            temperature=torch.tensor(temperature),
            suggestions=suggestions,
        )
    )


@pytest.mark.parametrize(
    ("discount", "temperature", "suggestions", "expected"),
    [
        (0.9, 0.0, 1, 14.5),  # 1 + .9 * 15
        (0.9, 0.5, 1, 15.4),  # 1 + .9 * (15 + .5 * 2)
        (0.9, 0.5, 4, 15.11367),  # 1 + .9 * (15 + .5 * (2 - .63629))
        (0.729, 0.0, 1, 11.935),  # three steps: 1 + .9^3 * 15
        (0.0, 0.5, 4, 1.0),  # terminal
    ],
)
def test_backup_by_hand(
    discount: float, temperature: float, suggestions: int, expected: float
) -> None:
    """Mean over the groups, less what the entropy costs, discounted."""
    assert one_target(discount, temperature, suggestions) == pytest.approx(expected, abs=1e-4)


@given(st.integers(1, 6), st.integers(1, 5), st.integers(1, 4), st.integers(0, 2**31))
def test_truncated_atoms_are_ascending_and_the_least(
    atoms: int, rows: int, critics: int, seed: int
) -> None:
    """Whatever the critics say."""
    q_value = torch.randn(critics, rows, atoms + 1, generator=torch.Generator().manual_seed(seed))
    for dropped in range(atoms + 1):
        kept = evaluate(q_value, dropped)
        assert kept.shape == (rows, critics * (atoms + 1 - dropped))
        every = q_value.transpose(0, 1).reshape(rows, -1).sort(1).values
        assert torch.equal(kept, every[:, : kept.shape[1]])
