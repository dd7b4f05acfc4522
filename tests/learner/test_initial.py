"""Beginning with what another run has learned: what fits is taken, whole or not at all."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import learner_of
from segments import segment

from a2s.actors.suggester import Suggester
from a2s.learner.initial import begin_with
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.off_policy_trainer import OffPolicyTrainer
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.run import checkpoint
from a2s.learner.run.config import Configuration, assemble, off_policy, on_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.trainer import Saved, Trainer
from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Spaces
from a2s.protocol.in_process import Exchange, InProcessBus

SMALL = {"critic_sizes": "16,16", "policy_sizes": "16,16", "precision": "f32"}
OBS = np.array([[0.3, -0.7]], np.float32)


def _spaces(obs_size: int = 2) -> Spaces:
    one = np.ones(1, np.float32)
    return Spaces(obs_size=obs_size, action_low=-one, action_high=one)


def _on_policy(seed: int, obs_size: int = 2, **hyper: Any) -> OnPolicyTrainer:
    config = on_policy("modern", "a2s", {"batch_steps": 8, "first_batch_steps": 8, **hyper})
    return OnPolicyTrainer(_spaces(obs_size), config, seed, {}, LearnerMetrics())


def _saved(path: Path, saved: Saved, variant: str) -> Path:
    """What a run leaves behind."""
    path.mkdir()
    hyper = '[hyper]\ncritic_sizes = [16, 16]\npolicy_sizes = [16, 16]\nprecision = "f32"\n'
    hyper = hyper if variant == "off-policy" else ""
    (path / "config.toml").write_text(f'[run]\nvariant = "{variant}"\n{hyper}')
    tensors, algorithm = saved
    checkpoint.save(path / "checkpoints", 3, tensors, {"algorithm": algorithm}, kind="any")
    return path


def _configuration(variant: str = "on-policy", **hyper: Any) -> Configuration:
    return assemble({"variant": variant}, {**(SMALL if variant == "off-policy" else {}), **hyper})


@pytest.fixture
def other(tmp_path: Path) -> tuple[Path, OnPolicyTrainer]:
    """A run that has learned from two batches."""
    trainer = _on_policy(seed=1)
    for first in (0, 4):
        for seq in range(first, first + 4):
            trainer.store(0, segment(seq, env=0))
        trainer.close_batch()
        trainer.learn(0.0)
    return _saved(tmp_path / "other", trainer.state(), "on-policy"), trainer


def _acts(trainer: Trainer, mode: Any = "mean") -> list[float]:
    choice = Suggester(trainer.graph(1, 0.0), mode)(OBS, np.random.default_rng(0))
    return [*choice.action.ravel().tolist(), *choice.q_spread.tolist()]


def test_it_acts_as_the_other_did_with_its_normaliser_and_its_q(
    other: tuple[Path, OnPolicyTrainer],
) -> None:
    path, trainer = other
    ours = _on_policy(seed=2)
    assert _acts(ours) != _acts(trainer)
    words = begin_with(ours, path, _configuration())
    assert words == f"begins with policy, value, q, normaliser of {path}"
    for mode in ("mean", "best-of-k", "behaviour"):
        assert _acts(ours, mode) == _acts(trainer, mode)


def test_all_else_begins_anew(other: tuple[Path, OnPolicyTrainer]) -> None:
    """No update is made yet, the window is empty, and Adam has no memory."""
    path, _ = other
    ours, fresh = _on_policy(seed=2), _on_policy(seed=2)
    begin_with(ours, path, _configuration())
    found, expected = ours.state()[0], fresh.state()[0]
    assert found.keys() == expected.keys()
    same = {name for name in found if torch.equal(found[name], expected[name])}
    changed = found.keys() - same
    assert {name.partition(".")[0] for name in changed} == {"policy", "value", "q", "normaliser"}
    assert ours.updates == 0


def test_a_network_of_another_size_is_left_out_and_named(
    other: tuple[Path, OnPolicyTrainer],
) -> None:
    path, trainer = other
    ours = _on_policy(seed=2, q_sizes="32,32")
    words = begin_with(ours, path, _configuration(q_sizes="32,32"))
    assert words.endswith("; not with q, which has other sizes there")
    assert _acts(ours)[0] == _acts(trainer)[0]
    assert _acts(ours, "best-of-k")[-1] == 0.0  # Q is not trusted yet


def test_what_cannot_be_begun_with_is_refused_and_changes_nothing(
    other: tuple[Path, OnPolicyTrainer], tmp_path: Path
) -> None:
    path, _ = other
    ours = _on_policy(seed=2, obs_size=3)
    before = {name: tensor.clone() for name, tensor in ours.state()[0].items()}
    with pytest.raises(UsageError, match=r"\(Hopper-v5\) does not fit: its .* \(Ant-v5\)"):
        begin_with(ours, path, assemble({"env": "Ant-v5"}, {}))
    with pytest.raises(UsageError, match="does not fit"):  # as many numbers, in other layers
        begin_with(_on_policy(seed=2), path, _configuration(norm_obs="false"))
    with pytest.raises(UsageError, match="is on-policy, expected off-policy"):
        begin_with(ours, path, _configuration("off-policy"))
    with pytest.raises(UsageError, match=r"config.toml"):
        begin_with(ours, tmp_path / "nowhere", _configuration())
    assert all(torch.equal(before[name], tensor) for name, tensor in ours.state()[0].items())


class _NoSource:
    """A source of nothing."""

    columns = ()

    def state(self) -> dict[str, Any]:
        return {}


def _off_policy(seed: int) -> OffPolicyTrainer:
    algorithm = OffPolicy(2, 1, off_policy("modern", SMALL), seed, "cpu")
    source: Any = _NoSource()
    return OffPolicyTrainer(algorithm, source, _spaces(), {}, LearnerMetrics())


def test_off_policy_actors_play_what_was_learned_from_the_first_step(tmp_path: Path) -> None:
    """Not random actions, as they do before anything is known."""
    trainer = _off_policy(seed=1)
    path = _saved(tmp_path / "other", (trainer.state()[0], {}), "off-policy")
    ours = _off_policy(seed=2)
    warm_up = Suggester(ours.graph(1, 0.0)).metadata["mode"]
    begin_with(ours, path, _configuration("off-policy"))
    assert Suggester(ours.graph(1, 0.0)).metadata["mode"] != warm_up
    first = next(iter(trainer.state()[0]))
    assert torch.equal(ours.state()[0][first], trainer.state()[0][first])


def test_and_so_they_do_when_it_goes_on_before_its_first_update(tmp_path: Path) -> None:
    path = _saved(tmp_path / "other", (_off_policy(seed=1).state()[0], {}), "off-policy")
    options = {"env": "Test-v0", "variant": "off-policy", "init_from": str(path)}
    run, modes = tmp_path / "run", []
    run.mkdir()
    for resume in (False, True):
        bus = InProcessBus(Exchange())
        learner_of(options, SMALL, bus, run, resume=resume).run(lambda: True)
        policy = (run / "latest" / "policy.onnx").read_bytes()
        modes.append(Suggester(policy).metadata["mode"])
    assert modes[0] == modes[1]
