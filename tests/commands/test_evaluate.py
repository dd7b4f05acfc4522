"""Evaluation: fresh episodes, the same again for the same seed, from a run or from a file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from a2s.commands.evaluate import evaluate_run
from a2s.protocol.errors import UsageError

MakeGraph = Callable[..., bytes]
COUNT = "a2s_test_envs:Count-v0"


@pytest.fixture
def policy(tmp_path: Path, make_graph: MakeGraph) -> Path:
    """A policy file for the counting environment."""
    path = tmp_path / "policy.onnx"
    path.write_bytes(make_graph())
    return path


def _evaluate(run: Path, env: str | None = None, **changed: object) -> dict[str, object]:
    options = {"episodes": 4, "mode": "mean", "weights": "latest", "seed": 0, **changed}
    return evaluate_run(run, {"env": env}, **options)  # type: ignore[arg-type]


def test_every_episode_is_played_to_its_end(policy: Path) -> None:
    """Rewards of 1 to 5 in five steps."""
    result = _evaluate(policy)
    assert result["env"] == COUNT
    assert (result["returns"], result["lengths"]) == ([15.0] * 4, [5] * 4)
    assert (result["mean"], result["std"], result["episodes"]) == (15.0, 0.0, 4)


@pytest.mark.parametrize("mode", ["mean", "best-of-k", "behaviour"])
def test_a_seed_gives_the_same_episodes_and_another_gives_others(
    tmp_path: Path, make_graph: MakeGraph, mode: str
) -> None:
    path = tmp_path / "hopper.onnx"
    path.write_bytes(make_graph(obs_size=11, low=(-1.0,) * 3, high=(1.0,) * 3))
    first, again, other = (
        _evaluate(path, "Hopper-v5", mode=mode, seed=seed)["returns"] for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other
    assert isinstance(first, list)
    assert len(set(first)) == 4


def test_the_environment_of_a_run_is_known_and_its_weights_can_be_chosen(
    tmp_path: Path, make_graph: MakeGraph
) -> None:
    run = tmp_path / "run"
    (run / "best").mkdir(parents=True)
    (run / "best" / "policy.onnx").write_bytes(make_graph())
    (run / "config.toml").write_text(f'[run]\nenv = "{COUNT}"\n')
    assert _evaluate(run, weights="best")["mean"] == 15.0
    for damaged in ("run = 3", "[run]\nenvs = []", "[run]\nenvs = 0"):  # the policy says enough
        (run / "config.toml").write_text(damaged)
        assert _evaluate(run, weights="best")["mean"] == 15.0
    with pytest.raises(UsageError, match=r"latest/policy.onnx: No such file"):
        _evaluate(run)


@pytest.mark.parametrize(
    ("told", "expected"), [(True, "Count-v0: 15.0"), (False, "CountTiny-v0: 1.5e-05")]
)
def test_a_variable_that_is_set_for_training_does_not_change_what_a_run_plays(
    tmp_path: Path,
    make_graph: MakeGraph,
    a2s: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
    told: bool,
    expected: str,
) -> None:
    """For a policy that knows no environment the variable counts."""
    path = tmp_path / "policy.onnx"
    path.write_bytes(make_graph() if told else make_graph(metadata={}))
    monkeypatch.setenv("A2S_ENV", "a2s_test_envs:CountTiny-v0")
    said = a2s("evaluate", path, "--episodes", 2)
    assert said[1].startswith(f"a2s_test_envs:{expected}"), said


def test_what_could_not_be_used_is_told_beside_the_result(
    policy: Path, a2s: Callable[..., tuple[int, str, str]]
) -> None:
    code, out, error = a2s("evaluate", policy, "--env", "a2s_test_envs:NanReward-v0")
    assert (code, error.count("reward is nan")) == (0, 1)
    assert out.endswith("; 10 steps had numbers that could not be used\n")


def test_a_policy_of_other_sizes_is_refused(policy: Path) -> None:
    with pytest.raises(UsageError, match=r"found .*\(2, 2\), expected \(11, 3\) for Hopper-v5"):
        _evaluate(policy, "Hopper-v5")


def test_a_file_that_is_no_policy_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.onnx").write_text("not a policy")
    with pytest.raises(UsageError, match=r"x.onnx: policy graph: found"):
        _evaluate(tmp_path / "x.onnx")


def test_returns_of_any_size_can_be_told_apart(
    policy: Path, a2s: Callable[..., tuple[int, str, str]]
) -> None:
    """Rewards of a millionth: 15e-6, not 0.0; and of one: 15.0."""
    for name, mean in (("CountTiny-v0", "1.5e-05"), ("Count-v0", "15.0")):
        env = f"a2s_test_envs:{name}"
        assert a2s("evaluate", policy, "--env", env, "--episodes", 2)[1] == (
            f"{env}: {mean} +- 0.0 over 2 episodes (mean); from {mean} to {mean}\n"
        )
