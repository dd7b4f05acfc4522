"""The ONNX graph of an off-policy suggester against the suggester it was made from."""

import itertools
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from a2s.learner.export.graph import CONTRACT
from a2s.learner.export.off_policy import export
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.run.config import off_policy

torch.set_num_threads(1)

LOW, HIGH = torch.tensor([-0.4, -3.0, 0.5]), torch.tensor([0.4, 1.0, 2.5])


def make(mode: str, **options: Any) -> OffPolicySuggester:
    """A suggester whose every number differs from its first value."""
    sizes = {"critic_sizes": "9,6", "policy_sizes": "8,7", "act_suggestions": 5}
    own: dict[str, Any] = {"act_suggestions": 1} if mode == "first" else {}
    own |= {"selection": mode} if mode in ("hard", "soft") else {}
    given = {**sizes, **options, **own}
    algorithm = OffPolicy(4, 3, off_policy("modern", given), 0)
    generator = torch.Generator().manual_seed(3)
    for ensemble in (algorithm.train_state.policy, algorithm.train_state.critics):
        ensemble.value += 0.3 * torch.randn(ensemble.value.shape, generator=generator)
        ensemble.refresh()
    algorithm.observe(2.0 * torch.randn(100, 4, generator=generator) + 1.0)
    algorithm.observe_returns(torch.tensor([3.0, -4.0]))
    suggester = algorithm.suggester(LOW, HIGH, warms_up=mode == "uniform")
    assert suggester.mode == mode
    return suggester


def session(data: bytes) -> ort.InferenceSession:
    """Open a graph as an actor does."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def assert_agree(suggester: OffPolicySuggester, rows: int = 33) -> None:
    """Run both on the same numbers, one wild observation among them."""
    generator = torch.Generator().manual_seed(rows)
    obs = 3.0 * torch.randn(rows, 4, generator=generator)
    obs[0] = 1e4
    normal = torch.randn(rows, suggester.suggestions, 3, generator=generator)
    feed = {"obs": obs.numpy(), "normal": normal.numpy()}
    gumbel = None
    if suggester.mode == "soft":
        gumbel = torch.randn(rows, suggester.suggestions, generator=generator)
        gumbel[::3] = 0.0
        feed["gumbel"] = gumbel.numpy()
    expected = suggester(obs, normal, gumbel)
    found = session(export(suggester, 1, {})).run(list(expected._fields), feed)
    for name, theirs, ours in zip(expected._fields, found, expected, strict=True):
        assert theirs.dtype == np.float32
        # Of the wild observation all K may be at the bounds: which is picked is rounding noise.
        first = 1 if name == "log_prob" and suggester.suggestions > 1 and rows > 1 else 0
        np.testing.assert_allclose(
            theirs[first:], ours.numpy()[first:], atol=1e-5, rtol=1e-5, err_msg=name
        )


@pytest.mark.parametrize(
    ("mode", "network", "layer_norm", "critics"),
    list(
        itertools.product(
            ["first", "hard", "soft"], ["mlp", "residual", "trunk"], [True, False], [1, 2, 3]
        )
    ),
)
def test_graph_agrees_for_every_form_of_network(
    mode: str, network: str, layer_norm: bool, critics: int
) -> None:
    """Each form has nodes of its own."""
    assert_agree(make(mode, network=network, layer_norm=layer_norm, num_critics=critics))


@pytest.mark.parametrize(
    "options",
    [
        {"norm_obs": False},
        {"norm_return": False},
        {"num_quantiles": 7, "quantiles_to_drop": 1},
        {"precision": "bf16"},
        {"policy_sizes": "12", "critic_sizes": "6"},
        {"policy_sizes": "12,5,4", "critic_sizes": "6,5,4", "network": "residual"},
        {"critic_sizes": "6,5,4", "network": "trunk"},
    ],
    ids=str,
)
@pytest.mark.parametrize("mode", ["uniform", "first", "hard", "soft"])
def test_graph_agrees_for_every_other_option(mode: str, options: dict[str, Any]) -> None:
    """One at a time."""
    assert_agree(make(mode, **options))


@pytest.mark.parametrize("rows", [1, 2, 300])
def test_graph_takes_any_number_of_observations(rows: int) -> None:
    """Actors step as many environments as they like."""
    assert_agree(make("hard"), rows)


@pytest.mark.parametrize("mode", ["uniform", "first", "hard"])
def test_action_stays_within_asymmetric_bounds(mode: str) -> None:
    """Noise of 50 standard deviations reaches all of them; the suggestion stays canonical."""
    suggester = make(mode)
    generator = torch.Generator().manual_seed(0)
    normal = 50.0 * torch.randn(64, suggester.suggestions, 3, generator=generator)
    feed = {"obs": np.zeros((64, 4), np.float32), "normal": normal.numpy()}
    run = session(export(suggester, 0, {})).run
    action, suggestion, log_prob = run(["action", "suggestion", "log_prob"], feed)
    assert (action >= LOW.numpy()).all()
    assert (action <= HIGH.numpy()).all()
    np.testing.assert_allclose(action.min(0), LOW.numpy(), atol=1e-4)
    np.testing.assert_allclose(action.max(0), HIGH.numpy(), atol=1e-4)
    assert np.abs(suggestion).max() <= 1.0
    assert np.isfinite(log_prob).all()


def test_graph_says_what_it_is() -> None:
    """Its own entries win over those of the caller."""
    model = onnx.load_from_string(export(make("hard"), 41, {"env": "Hopper-v5", "K": "no"}))
    onnx.checker.check_model(model, full_check=True)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert told["env"] == "Hopper-v5"
    assert (told["weights_version"], told["K"], told["mode"]) == ("41", "5", "hard")
    assert (told["contract"], told["obs_size"], told["action_size"]) == (CONTRACT, "4", "3")


@pytest.mark.parametrize(("mode", "k"), [("uniform", 1), ("first", 1), ("hard", 5), ("soft", 5)])
def test_graph_asks_for_the_noise_that_it_needs(mode: str, k: int) -> None:
    """An actor feeds what a graph asks for."""
    inputs = session(export(make(mode), 0, {})).get_inputs()
    expected: dict[str, list[str | int]] = {"obs": ["B", 4], "normal": ["B", k, 3]}
    if mode == "soft":
        expected["gumbel"] = ["B", 5]
    assert {item.name: item.shape for item in inputs} == expected


@pytest.mark.parametrize("mode", ["uniform", "first", "hard", "soft"])
def test_a_graph_holds_no_number_that_it_does_not_read(mode: str) -> None:
    """Uniform actions need no observation."""
    graph = onnx.load_from_string(export(make(mode), 0, {})).graph
    read = {name for node in graph.node for name in node.input}
    assert {number.name for number in graph.initializer} <= read


def test_later_export_has_the_later_weights() -> None:
    """Only the nodes are remembered."""
    suggester = make("hard")
    before = export(suggester, 0, {})
    suggester.policy.value.add_(0.1)
    assert before != export(suggester, 0, {})
    assert_agree(suggester)
