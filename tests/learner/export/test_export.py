"""The ONNX graphs of both variants against the suggesters that they were made from."""

import itertools
import time
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from a2s.learner.export import off_policy as off_policy_graph
from a2s.learner.export import on_policy as on_policy_graph
from a2s.learner.export.graph import CONTRACT
from a2s.learner.networks.normaliser import Normaliser
from a2s.learner.off_policy.acting import OffPolicySuggester
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.on_policy import acting
from a2s.learner.on_policy.acting import ActionMode, Suggester
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.state import make_critic, make_policy, make_q
from a2s.learner.run.config import off_policy, on_policy

torch.set_num_threads(1)

LOW, HIGH = torch.tensor([-0.4, -3.0, 0.5]), torch.tensor([0.4, 1.0, 2.5])
ON_MODES, OFF_MODES = ("first", "hard", "soft"), ("uniform", "first", "hard", "soft")
EVERY = [*itertools.product(["on"], ON_MODES), *itertools.product(["off"], OFF_MODES)]
AnySuggester = Suggester | OffPolicySuggester


def make(variant: str, mode: str, **options: Any) -> AnySuggester:
    """A suggester every weight of which differs from its first value."""
    return (make_on if variant == "on" else make_off)(mode, **options)


def make_on(
    mode: str,
    action_mode: ActionMode = "clip",
    critics: int = 2,
    inverse_temperature: float = 1.5,
    **options: Any,
) -> Suggester:
    """With two categorical critics, or with the one of the presets authors and paper."""
    hyper = on_policy("modern", "a2s", {"q_sizes": "9,6", "policy_sizes": "8,7", **options})
    assert isinstance(hyper, OnPolicyConfig)
    generator = torch.Generator().manual_seed(3)
    policy = make_policy(4, 3, hyper, generator)
    q_net = (
        make_q(7, hyper.q_sizes, generator)
        if critics == 2
        else make_critic(7, hyper.q_sizes, hyper, generator)
    )
    for value in (policy.value, policy.log_std, q_net.value):
        value += 0.3 * torch.randn(value.shape, generator=generator)
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
        suggestions=1 if first else 5,
        inverse_temperature=inverse_temperature,
        action_mode=action_mode,
        q_scale=7.0,
    )


def make_off(mode: str, **options: Any) -> OffPolicySuggester:
    sizes = {"critic_sizes": "9,6", "policy_sizes": "8,7", "act_suggestions": 5}
    own: dict[str, Any] = {"act_suggestions": 1} if mode == "first" else {}
    own |= {"selection": mode} if mode in ("hard", "soft") else {}
    algorithm = OffPolicy(4, 3, off_policy("modern", {**sizes, **options, **own}), 0)
    generator = torch.Generator().manual_seed(3)
    for ensemble in (algorithm.train_state.policy, algorithm.train_state.critics):
        ensemble.value += 0.3 * torch.randn(ensemble.value.shape, generator=generator)
        ensemble.refresh()
    algorithm.observe(2.0 * torch.randn(100, 4, generator=generator) + 1.0)
    algorithm.observe_returns(torch.tensor([3.0, -4.0]))
    suggester = algorithm.suggester(LOW, HIGH, warms_up=mode == "uniform")
    assert suggester.mode == mode
    return suggester


def export(suggester: AnySuggester, version: int = 0, **metadata: str) -> bytes:
    if isinstance(suggester, Suggester):
        return on_policy_graph.export(suggester, version, metadata)
    return off_policy_graph.export(suggester, version, metadata)


def session(data: bytes) -> ort.InferenceSession:
    """Open a graph as an actor does."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def assert_agree(suggester: AnySuggester, rows: int = 33) -> None:
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
    found = session(export(suggester)).run(list(expected._fields), feed)
    for name, theirs, ours in zip(expected._fields, found, expected, strict=True):
        assert theirs.dtype == np.float32
        # Of the wild observation all K are nearly alike: which is picked is rounding noise.
        first = 1 if name == "log_prob" and suggester.suggestions > 1 and rows > 1 else 0
        if name == "q_spread":  # of the wild one: a difference of values a hundred times as large
            np.testing.assert_allclose(theirs[0], ours.numpy()[0], atol=1e-4, rtol=1e-5)
            first = 1
        np.testing.assert_allclose(
            theirs[first:], ours.numpy()[first:], atol=1e-5, rtol=1e-5, err_msg=name
        )


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"layer_norm": False},
        {"norm_obs": False},
        {"action_mode": "raw"},
        {"inverse_temperature": 0.25},
        {"critics": 1},
        {"policy_sizes": "12", "q_sizes": "6"},
        {"policy_sizes": "12,5,4", "q_sizes": "6,5,4"},
    ],
    ids=str,
)
@pytest.mark.parametrize("mode", ON_MODES)
def test_on_policy_graph_agrees_for_every_option(mode: str, options: dict[str, Any]) -> None:
    """One at a time."""
    assert_agree(make_on(mode, **options))


@pytest.mark.parametrize("network", ["mlp", "residual", "trunk"])
@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("critics", [1, 2, 3])
@pytest.mark.parametrize("mode", ["first", "hard", "soft"])
def test_off_policy_graph_agrees_for_every_form_of_network(
    mode: str, network: str, layer_norm: bool, critics: int
) -> None:
    """Each form has nodes of its own."""
    assert_agree(make_off(mode, network=network, layer_norm=layer_norm, num_critics=critics))


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
@pytest.mark.parametrize("mode", OFF_MODES)
def test_off_policy_graph_agrees_for_every_other_option(mode: str, options: dict[str, Any]) -> None:
    """One at a time."""
    assert_agree(make_off(mode, **options))


@pytest.mark.parametrize("rows", [1, 2, 300])
@pytest.mark.parametrize(("variant", "mode"), [("on", "soft"), ("off", "hard")])
def test_graph_takes_any_number_of_observations(variant: str, mode: str, rows: int) -> None:
    """Actors step as many environments as they like."""
    assert_agree(make(variant, mode), rows)


@pytest.mark.parametrize(("variant", "mode"), EVERY)
def test_action_stays_within_asymmetric_bounds(variant: str, mode: str) -> None:
    """Noise of 50 standard deviations reaches all of them; off-policy the suggestion does not."""
    suggester = make(variant, mode)
    generator = torch.Generator().manual_seed(0)
    normal = 50.0 * torch.randn(64, suggester.suggestions, 3, generator=generator)
    feed = {"obs": np.zeros((64, 4), np.float32), "normal": normal.numpy()}
    if mode == "soft":
        feed["gumbel"] = np.zeros((64, 5), np.float32)
    outputs = ["action", "suggestion", "log_prob"]
    action, suggestion, log_prob = session(export(suggester)).run(outputs, feed)
    assert (action >= LOW.numpy()).all()
    assert (action <= HIGH.numpy()).all()
    np.testing.assert_allclose(action.min(0), LOW.numpy(), atol=1e-4)
    np.testing.assert_allclose(action.max(0), HIGH.numpy(), atol=1e-4)
    assert (np.abs(suggestion).max() <= 1.0) == (variant == "off")
    assert np.isfinite(log_prob).all()


@pytest.mark.parametrize("variant", ["on", "off"])
def test_graph_says_what_it_is(variant: str) -> None:
    """Its own entries win over those of the caller."""
    model = onnx.load_from_string(export(make(variant, "hard"), 41, env="Hopper-v5", K="no"))
    onnx.checker.check_model(model, full_check=True)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert told["env"] == "Hopper-v5"
    assert (told["weights_version"], told["K"], told["mode"]) == ("41", "5", "hard")
    assert (told["contract"], told["obs_size"], told["action_size"]) == (CONTRACT, "4", "3")


@pytest.mark.parametrize(("variant", "mode"), EVERY)
def test_graph_asks_for_the_noise_and_holds_the_numbers_that_it_needs(
    variant: str, mode: str
) -> None:
    """An actor feeds what a graph asks for; uniform actions need no observation."""
    data = export(make(variant, mode))
    k = 5 if mode in ("hard", "soft") else 1
    expected: dict[str, list[str | int]] = {"obs": ["B", 4], "normal": ["B", k, 3]}
    if mode == "soft":
        expected["gumbel"] = ["B", 5]
    assert {item.name: item.shape for item in session(data).get_inputs()} == expected
    graph = onnx.load_from_string(data).graph
    read = {name for node in graph.node for name in node.input}
    assert {number.name for number in graph.initializer} <= read


def test_later_export_has_the_later_weights() -> None:
    """Only the nodes are remembered."""
    on, off = make_on("first"), make_off("hard")
    before = export(on), export(off)
    on.policy.log_std.add_(1.0)
    off.policy.value.add_(0.1)
    assert (export(on) != before[0], export(off) != before[1]) == (True, True)
    assert_agree(on)
    assert_agree(off)


def test_tiny_and_silent_observations_are_those_of_the_suggester() -> None:
    """Of a millionth, always 0, always 8.9, and a million that varies by its rounding alone."""
    suggester = make_on("soft")
    obs = torch.randn(33, 4) * torch.tensor([1e-6, 0.0, 0.0, 0.06])
    obs += torch.tensor([0.0, 0.0, 8.9, 1e6])
    suggester.normaliser = Normaliser(4, enabled=True)
    suggester.normaliser.update(obs)
    obs[0, 1:3] = 1.0
    normal, gumbel = torch.zeros(33, 5, 3), torch.zeros(33, 5)
    expected = suggester(obs, normal, gumbel).suggestion
    feed = {"obs": obs.numpy(), "normal": normal.numpy(), "gumbel": gumbel.numpy()}
    (found,) = session(export(suggester)).run(["suggestion"], feed)
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-5)
    assert (np.ptp(found, axis=0) > 0.1).all()  # what is a millionth is seen


def test_noise_chooses_the_way_of_acting() -> None:
    """Zero noise is the mean; a mean among the candidates is never beaten by a worse one."""
    suggester = make_on("soft")
    run = session(export(suggester)).run
    obs = torch.randn(20, 4)
    normal, gumbel = torch.randn(20, 5, 3), torch.zeros(20, 5)
    feed = {"obs": obs.numpy(), "gumbel": gumbel.numpy()}
    seen = suggester.normaliser(obs)
    mean = suggester.policy(seen)
    (at_mean,) = run(["suggestion"], {**feed, "normal": np.zeros((20, 5, 3), np.float32)})
    np.testing.assert_allclose(at_mean, mean.numpy(), atol=1e-5)
    normal[:, 0] = 0.0
    (best,) = run(["suggestion"], {**feed, "normal": normal.numpy()})
    assert suggester.q_net is not None
    shown = torch.stack([torch.from_numpy(best), mean], 1).clamp(-1, 1)
    chosen, plain = acting.q_scores(suggester.q_net, seen, shown).T
    assert bool((chosen >= plain - 1e-5).all())


def test_replicated_noise_makes_a_plain_step() -> None:
    """The selection is left nothing to choose."""
    suggester = make_on("soft")
    one = torch.randn(20, 1, 3)
    obs = torch.randn(20, 4)
    choice = suggester(obs, one.expand(20, 5, 3), torch.randn(20, 5))
    mean = suggester.policy(suggester.normaliser(obs))
    expected = mean + one[:, 0] * suggester.policy.std()
    torch.testing.assert_close(choice.suggestion, expected)
    torch.testing.assert_close(choice.q_spread, torch.zeros(20), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("mode", ON_MODES)
def test_log_prob_is_that_of_the_suggestion_as_executed(mode: str) -> None:
    """Of the policy; soft selection adds how much likelier it made the choice than 1 in K."""
    suggester = make_on(mode, inverse_temperature=0.7)
    obs, normal = torch.randn(9, 4), torch.randn(9, suggester.suggestions, 3)
    choice = suggester(obs, normal, torch.randn(9, suggester.suggestions))
    seen = suggester.normaliser(obs)
    policy = torch.distributions.Normal(suggester.policy(seen), suggester.policy.std())
    expected = policy.log_prob(choice.suggestion).sum(1)  # type: ignore[no-untyped-call]
    if mode == "soft" and suggester.q_net is not None:
        candidates = suggester.policy(seen).unsqueeze(1) + suggester.policy.std() * normal
        q_value = acting.q_scores(suggester.q_net, seen, candidates.clamp(-1, 1))
        chance = (0.7 * q_value).softmax(1)
        chosen = (candidates == choice.suggestion.unsqueeze(1)).all(2)
        expected += (5 * chance[chosen]).log()
    torch.testing.assert_close(choice.log_prob, expected, atol=1e-4, rtol=1e-4)


def test_export_takes_less_than_five_milliseconds() -> None:
    """It happens at every version."""
    suggester = make_on("soft", q_sizes="128,128", policy_sizes="64,64")
    times = []
    for version in range(20):
        start_s = time.perf_counter()
        export(suggester, version)
        times.append(time.perf_counter() - start_s)
    assert min(times) < 5e-3
