"""The ONNX graph against the suggester it was made from."""

import time
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from a2s.learner.export.graph import CONTRACT
from a2s.learner.export.on_policy import export
from a2s.learner.networks.networks import Normaliser, Policy, Q
from a2s.learner.on_policy.acting import ActionMode, Suggester
from a2s.learner.on_policy.config import OnPolicyConfig

torch.set_num_threads(1)

LOW, HIGH = torch.tensor([-0.4, -3.0, 0.5]), torch.tensor([0.4, 1.0, 2.5])


def make(
    mode: str, suggestions: int = 5, action_mode: ActionMode = "clip", **options: Any
) -> Suggester:
    """A suggester whose every number differs from its first value."""
    hyper = OnPolicyConfig(**{"q_sizes": (9, 6), "policy_sizes": (8, 7), **options})
    generator = torch.Generator().manual_seed(3)
    policy, q_net = Policy(4, 3, hyper, generator), Q(4, 3, hyper, generator)
    with torch.no_grad():
        for parameter in [*policy.parameters(), *q_net.parameters()]:
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
    normaliser = Normaliser(4, enabled=hyper.norm_obs)
    normaliser.update(2.0 * torch.randn(100, 4, generator=generator) + 1.0)
    first = mode == "first"
    return Suggester(
        normaliser=normaliser,
        policy=policy,
        q_net=None if first else q_net,
        action_low=LOW,
        action_high=HIGH,
        mode=mode,  # type: ignore[arg-type]
        suggestions=1 if first else suggestions,
        temperature=hyper.selection_temperature,
        action_mode=action_mode,
        q_scale=7.0,
    )


def session(data: bytes) -> ort.InferenceSession:
    """Open a graph as an actor does."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def assert_agree(suggester: Suggester, rows: int = 33) -> None:
    """Run both on the same numbers, one wild observation among them."""
    generator = torch.Generator().manual_seed(rows)
    obs = 3.0 * torch.randn(rows, 4, generator=generator)
    obs[0] = 1e4
    normal = torch.randn(rows, suggester.suggestions, 3, generator=generator)
    gumbel = torch.randn(rows, suggester.suggestions, generator=generator)
    feed = {"obs": obs.numpy(), "normal": normal.numpy()}
    if suggester.mode == "soft":
        feed["gumbel"] = gumbel.numpy()
    with torch.no_grad():
        expected = suggester(obs, normal, gumbel if suggester.mode == "soft" else None)
    found = session(export(suggester, 1, {})).run(list(expected._fields), feed)
    for name, theirs, ours in zip(expected._fields, found, expected, strict=True):
        assert theirs.dtype == np.float32
        # For the wild observation all K are nearly equal: which Q prefers is rounding noise.
        first = 1 if name == "log_prob" and suggester.mode == "soft" and rows > 1 else 0
        if name == "q_spread":  # of the wild one: a difference of values a hundred times as large
            np.testing.assert_allclose(theirs[0], ours.numpy()[0], atol=1e-4, rtol=1e-5)
            first = 1
        np.testing.assert_allclose(
            theirs[first:], ours.numpy()[first:], atol=1e-5, rtol=1e-5, err_msg=name
        )


@pytest.mark.parametrize("mode", ["first", "hard", "soft"])
@pytest.mark.parametrize("layer_norm", [True, False])
def test_graph_agrees_for_every_form_of_network(mode: str, layer_norm: bool) -> None:
    """Each form has nodes of its own."""
    assert_agree(make(mode, layer_norm=layer_norm))


@pytest.mark.parametrize(
    "options",
    [
        {"norm_obs": False},
        {"std": 0.7},
        {"action_mode": "raw"},
        {"selection_temperature": 0.25},
        {"policy_sizes": (12,), "q_sizes": (6,)},
        {"policy_sizes": (12, 5, 4), "q_sizes": (6, 5, 4)},
    ],
    ids=str,
)
@pytest.mark.parametrize("mode", ["first", "hard", "soft"])
def test_graph_agrees_for_every_other_option(mode: str, options: dict[str, Any]) -> None:
    """One at a time."""
    assert_agree(make(mode, **options))


@pytest.mark.parametrize("rows", [1, 2, 300])
def test_graph_takes_any_number_of_observations(rows: int) -> None:
    """Actors step as many environments as they like."""
    assert_agree(make("soft"), rows)


def test_action_stays_within_asymmetric_bounds() -> None:
    """Noise of 50 standard deviations reaches all of them."""
    suggester = make("soft")
    normal = 50.0 * torch.randn(64, 5, 3)
    feed = {"obs": np.zeros((64, 4), np.float32), "normal": normal.numpy()}
    feed["gumbel"] = np.zeros((64, 5), np.float32)
    (action,) = session(export(suggester, 0, {})).run(["action"], feed)
    assert (action >= LOW.numpy()).all()
    assert (action <= HIGH.numpy()).all()
    assert (action == LOW.numpy()).any()
    assert (action == HIGH.numpy()).any()


def test_tiny_and_silent_observations_are_those_of_the_suggester() -> None:
    """Of a millionth, always 0, always 8.9, and a million that varies by its rounding alone."""
    suggester = make("soft")
    obs = torch.randn(33, 4) * torch.tensor([1e-6, 0.0, 0.0, 0.06])
    obs += torch.tensor([0.0, 0.0, 8.9, 1e6])
    suggester.normaliser = Normaliser(4, enabled=True)
    suggester.normaliser.update(obs)
    obs[0, 1:3] = 1.0
    normal, gumbel = torch.zeros(33, 5, 3), torch.zeros(33, 5)
    with torch.no_grad():
        expected = suggester(obs, normal, gumbel).suggestion
    feed = {"obs": obs.numpy(), "normal": normal.numpy(), "gumbel": gumbel.numpy()}
    (found,) = session(export(suggester, 0, {})).run(["suggestion"], feed)
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-5)
    assert (np.ptp(found, axis=0) > 0.1).all()  # what is a millionth is seen


def test_noise_chooses_the_way_of_acting() -> None:
    """Zero noise is the mean; a mean among the candidates is never beaten by a worse one."""
    suggester = make("soft")
    run = session(export(suggester, 0, {})).run
    obs = torch.randn(20, 4)
    normal, gumbel = torch.randn(20, 5, 3), torch.zeros(20, 5)
    feed = {"obs": obs.numpy(), "gumbel": gumbel.numpy()}
    with torch.no_grad():
        seen = suggester.normaliser(obs)
        mean = suggester.policy(seen)
    (at_mean,) = run(["suggestion"], {**feed, "normal": np.zeros((20, 5, 3), np.float32)})
    np.testing.assert_allclose(at_mean, mean.numpy(), atol=1e-5)
    normal[:, 0] = 0.0
    (best,) = run(["suggestion"], {**feed, "normal": normal.numpy()})
    assert suggester.q_net is not None
    with torch.no_grad():
        chosen = suggester.q_net.score(seen, torch.from_numpy(best).clamp(-1, 1).unsqueeze(1))
        plain = suggester.q_net.score(seen, mean.clamp(-1, 1).unsqueeze(1))
    assert bool((chosen >= plain - 1e-5).all())


def test_replicated_noise_makes_a_plain_step() -> None:
    """The selection is left nothing to choose."""
    suggester = make("soft")
    one = torch.randn(20, 1, 3)
    plain, gumbel = one.expand(20, 5, 3), torch.randn(20, 5)
    obs = torch.randn(20, 4)
    with torch.no_grad():
        choice = suggester(obs, plain, gumbel)
        mean = suggester.policy(suggester.normaliser(obs))
        expected = mean + one[:, 0] * suggester.policy.std()
    torch.testing.assert_close(choice.suggestion, expected)
    torch.testing.assert_close(choice.q_spread, torch.zeros(20), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("mode", ["first", "hard", "soft"])
def test_log_prob_is_that_of_the_suggestion_as_executed(mode: str) -> None:
    """Of the policy; soft selection adds how much likelier it made the choice than 1 in K."""
    suggester = make(mode, selection_temperature=0.7)
    obs, normal = torch.randn(9, 4), torch.randn(9, suggester.suggestions, 3)
    choice = suggester(obs, normal, torch.randn(9, suggester.suggestions))
    seen = suggester.normaliser(obs)
    policy = torch.distributions.Normal(suggester.policy(seen), suggester.policy.std())
    expected = policy.log_prob(choice.suggestion).sum(1)  # type: ignore[no-untyped-call]
    if mode == "soft" and suggester.q_net is not None:
        candidates = suggester.policy(seen).unsqueeze(1) + suggester.policy.std() * normal
        q_value = suggester.q_net.score(seen, candidates.clamp(-1, 1))
        chance = (q_value / (q_value.std(1, correction=0, keepdim=True) * 0.7)).softmax(1)
        chosen = (candidates == choice.suggestion.unsqueeze(1)).all(2)
        expected += (5 * chance[chosen]).log()
    torch.testing.assert_close(choice.log_prob, expected, atol=1e-4, rtol=1e-4)


def test_graph_says_what_it_is() -> None:
    """Its own entries win over those of the caller."""
    model = onnx.load_from_string(export(make("soft"), 41, {"env": "Hopper-v5", "K": "no"}))
    onnx.checker.check_model(model, full_check=True)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert told["env"] == "Hopper-v5"
    assert told["weights_version"] == "41"
    assert told["K"] == "5"
    assert told["contract"] == CONTRACT


def test_only_soft_selection_asks_for_gumbel_noise() -> None:
    """An actor feeds what a graph asks for."""
    names = {
        mode: [item.name for item in session(export(make(mode), 0, {})).get_inputs()]
        for mode in ("first", "hard", "soft")
    }
    assert names == {
        "first": ["obs", "normal"],
        "hard": ["obs", "normal"],
        "soft": ["obs", "normal", "gumbel"],
    }


def test_later_export_has_the_later_weights() -> None:
    """Only the nodes are remembered."""
    suggester = make("first")
    before = export(suggester, 0, {})
    with torch.no_grad():
        suggester.policy.log_std.add_(1.0)
    assert before != export(suggester, 0, {})
    assert_agree(suggester)


def test_export_takes_less_than_five_milliseconds() -> None:
    """It happens at every version."""
    suggester = make("soft", q_sizes=(128, 64), policy_sizes=(64, 64))
    times = []
    for version in range(20):
        start_s = time.perf_counter()
        export(suggester, version, {})
        times.append(time.perf_counter() - start_s)
    assert min(times) < 5e-3
