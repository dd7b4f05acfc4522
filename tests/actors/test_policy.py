"""``a2s.load_policy``: a trained policy as a function of observations."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest

import a2s
from a2s.actors.environments.making import MAX_SEED
from a2s.actors.evaluation import _EVALUATION
from a2s.commands.evaluate import evaluate_run
from a2s.protocol.errors import UsageError

MakeGraph = Callable[..., bytes]


@pytest.fixture
def hopper(tmp_path: Path, make_graph: MakeGraph) -> Path:
    path = tmp_path / "policy.onnx"
    path.write_bytes(make_graph(obs_size=11, low=(-1.0,) * 3, high=(1.0,) * 3))
    return path


def test_it_reaches_what_evaluate_reaches(hopper: Path) -> None:
    """The same return and length, to the bit, of an episode with the same seed."""
    expected = evaluate_run(
        hopper, {"env": "Hopper-v5"}, episodes=1, mode="mean", weights="latest", seed=5
    )
    seeds = np.random.SeedSequence([_EVALUATION, 5]).generate_state(2) & MAX_SEED
    policy, env = a2s.load_policy(hopper), gymnasium.make("Hopper-v5")
    (obs, _), rewards, ends = env.reset(seed=int(seeds[0])), [], False
    while not ends:
        obs, reward, terminated, truncated, _ = env.step(policy(obs))
        rewards.append(float(reward))
        ends = terminated or truncated
    assert ([sum(rewards)], [len(rewards)]) == (expected["returns"], expected["lengths"])


def test_a_batch_is_acted_on_row_by_row(hopper: Path, rng: np.random.Generator) -> None:
    policy = a2s.load_policy(str(hopper))
    assert (policy.env_id, policy.obs_size, policy.action_size, policy.weights_version) == (
        "a2s_test_envs:Count-v0", 11, 3, 3
    )  # fmt: skip
    obs = rng.standard_normal((4, 11))
    actions = policy(obs)
    assert actions.shape == (4, 3)
    assert actions.dtype == np.float32
    assert np.allclose(actions, [policy(row) for row in obs], atol=1e-6)
    assert policy(obs[0].tolist()).shape == (3,)


@pytest.mark.parametrize("mode", ["behaviour", "best-of-k"])
def test_noise_is_repeated_by_its_seed(hopper: Path, mode: str) -> None:
    first, again, other = (a2s.load_policy(hopper, mode, seed)(np.zeros(11)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert mode == "best-of-k" or not np.array_equal(first, other)


def test_the_offset_of_observations_is_taken_off_in_float64(hopper: Path, tmp_path: Path) -> None:
    """A millionth beside a million is nothing in float32."""
    model = onnx.load(hopper)
    onnx.helper.set_model_props(
        model, {p.key: p.value for p in model.metadata_props} | {"obs_offset": str([1e6] * 11)}
    )
    onnx.save(model, tmp_path / "far.onnx")
    obs = np.linspace(-1e-3, 1e-3, 11)
    expected = a2s.load_policy(hopper)(obs)
    assert np.allclose(a2s.load_policy(tmp_path / "far.onnx")(obs + 1e6), expected, atol=1e-6)


def test_of_a_run_the_best_policy_is_taken_else_the_latest(
    tmp_path: Path, make_graph: MakeGraph
) -> None:
    for which, obs_size in (("latest", 2), ("best", 4)):
        (tmp_path / which).mkdir()
        (tmp_path / which / "policy.onnx").write_bytes(make_graph(obs_size=obs_size))
        assert a2s.load_policy(tmp_path).obs_size == obs_size


def test_a_mistake_gets_one_line(hopper: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nowhere: No such file or directory"):
        a2s.load_policy(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"latest/policy.onnx: No such file or directory"):
        a2s.load_policy(tmp_path)
    with pytest.raises(UsageError, match=r"mode: found 'men' \(did you mean 'mean'\?\)"):
        a2s.load_policy(hopper, mode="men")
    with pytest.raises(
        UsageError, match=r"obs: found shape \(2, 12\), expected \(11,\) or \(B, 11"
    ):
        a2s.load_policy(hopper)(np.zeros((2, 12)))
    parts: Any = {"a": np.zeros(11)}
    with pytest.raises(UsageError, match=r"obs: found a dict, expected an array; flatten it"):
        a2s.load_policy(hopper)(parts)
