"""The graph in ONNX Runtime: the noise decides the mode, and the bounds are kept."""

from collections.abc import Callable

import numpy as np
import pytest

from a2s.actors.suggester import Suggester
from a2s.protocol.errors import MalformedMessageError, UsageError
from a2s.protocol.fields import Spaces

MakeGraph = Callable[..., bytes]


def test_actions_keep_to_the_bounds_of_every_dimension(
    make_graph: MakeGraph, rng: np.random.Generator
) -> None:
    obs = rng.standard_normal((500, 2), dtype=np.float32) * 100
    action = Suggester(make_graph(std=3.0))(obs, rng).action
    assert action.min(axis=0).tolist() == [-1.0, 0.5]
    assert action.max(axis=0).tolist() == [3.0, 0.75]


def test_the_mean_action_has_no_noise(make_graph: MakeGraph, rng: np.random.Generator) -> None:
    suggester = Suggester(make_graph(), "mean")
    obs = rng.standard_normal((4, 2), dtype=np.float32)
    first, second = suggester(obs, rng).action, suggester(obs, rng).action
    assert np.array_equal(first, second)


def test_best_of_k_is_never_valued_below_the_mean_action(
    make_graph: MakeGraph, rng: np.random.Generator
) -> None:
    """The mean is one of the K; so it is where Q is worth nothing, as here at first."""
    graph = make_graph()
    obs = rng.standard_normal((64, 2), dtype=np.float32)
    best = Suggester(graph, "best-of-k")(obs, rng)
    mean = Suggester(graph, "mean")(obs, rng)
    assert (best.q_spread > 0).all()
    assert np.allclose(mean.q_spread, 0.0, atol=1e-5)
    assert not np.allclose(best.suggestion, mean.suggestion)


def test_behaviour_is_the_same_for_the_same_generator(make_graph: MakeGraph) -> None:
    suggester = Suggester(make_graph())
    obs = np.ones((3, 2), dtype=np.float32)
    runs = [suggester(obs, np.random.default_rng(5)) for _ in range(2)]
    for first, second in zip(*runs, strict=True):
        assert np.array_equal(first, second)


def test_one_graph_serves_any_number_of_observations(
    make_graph: MakeGraph, rng: np.random.Generator
) -> None:
    suggester = Suggester(make_graph())
    for batch in (1, 3, 16):
        choice = suggester(np.zeros((batch, 2), dtype=np.float32), rng)
        assert choice.action.shape == (batch, 2)
        assert choice.log_prob.shape == choice.q_spread.shape == (batch,)


@pytest.mark.parametrize("graph", [b"", b"not a graph", b"\x08\x09" * 50])
def test_damaged_bytes_are_malformed(graph: bytes) -> None:
    with pytest.raises(MalformedMessageError, match="policy graph"):
        Suggester(graph)


def test_a_policy_of_another_environment_is_refused(make_graph: MakeGraph) -> None:
    bound = np.ones(3, dtype=np.float32)
    spaces = Spaces(obs_size=11, action_low=-bound, action_high=bound)
    with pytest.raises(UsageError, match=r"found .*\(2, 2\), expected \(11, 3\) for Hopper-v5"):
        Suggester(make_graph()).check(spaces, "Hopper-v5")
