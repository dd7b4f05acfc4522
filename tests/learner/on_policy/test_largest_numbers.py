"""What a segment may hold at most leaves the networks finite: one actor cannot end a run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from a2s.learner.ingest.ledger import Ledger
from a2s.learner.ingest.store import Store
from a2s.learner.make import make_off_policy
from a2s.learner.on_policy import authors
from a2s.learner.on_policy_trainer import OnPolicyTrainer
from a2s.learner.run.config import off_policy, on_policy
from a2s.learner.run.metrics import LearnerMetrics
from a2s.learner.run.run_config import RunConfig
from a2s.learner.trainer import Trainer
from a2s.protocol.fields import Array, Spaces
from a2s.protocol.messages import MAX_PLAYED, MAX_SUGGESTED, Segment

SPACES = Spaces(obs_size=3, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))
STEPS = 16
LARGEST = {
    "obs": MAX_PLAYED,
    "final_obs": MAX_PLAYED,
    "reward": MAX_PLAYED,
    "suggestion": MAX_SUGGESTED,
    "log_prob": MAX_SUGGESTED,
}


def segment(seq: int, size: dict[str, float]) -> Segment:
    """Numbers of about 1, or of a size and either sign."""
    rng = np.random.default_rng(seq)

    def numbers(name: str, *shape: int) -> Array:
        drawn = rng.standard_normal(shape)
        return (np.sign(drawn) * size[name] if name in size else drawn).astype(np.float32)

    return Segment(
        actor="a", seq=seq, generation=1, epoch=0, weights_version=1, env=0,
        obs=numbers("obs", STEPS, 3), suggestion=numbers("suggestion", STEPS, 2),
        log_prob=numbers("log_prob", STEPS), reward=numbers("reward", STEPS),
        final_obs=numbers("final_obs", 3), terminated=True, truncated=False,
        episode_return=size.get("reward", 0.0), episode_length=STEPS,
    )  # fmt: skip


def play(trainer: Trainer, store: Store, size: dict[str, float]) -> None:
    """Learn from ordinary segments, from one of a size among them, from such alone, and go on."""
    rounds: list[list[dict[str, float]]] = [[{}, {}], [{}, size], [size, size], [{}, {}]]
    for number, sizes in enumerate(rounds):
        segments = [segment(2 * number + i, each) for i, each in enumerate(sizes)]
        for each in segments:
            store.store(0, each)
        store.close_batch()
        trainer.learn(0.0)


@pytest.mark.parametrize("names", [("suggestion",), ("log_prob",), tuple(LARGEST)], ids=",".join)
@pytest.mark.parametrize("preset", ["modern", "authors", "paper"])
def test_on_policy(preset: str, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    for steps in ("Q_EXTRA_STEPS", "VALUE_EXTRA_STEPS"):
        monkeypatch.setattr(authors, steps, 0)
    hyper = on_policy(preset, "a2s", {})
    trainer = OnPolicyTrainer(SPACES, hyper, 0, {}, LearnerMetrics())
    play(trainer, trainer, {name: LARGEST[name] for name in names})


@pytest.mark.parametrize(
    ("preset", "options"),
    [
        ("modern", {}),
        ("modern", {"norm_return": False, "prioritised": True, "n_step": 64}),
        ("sac", {}),
        ("paper", {}),
    ],
    ids=str,
)
def test_off_policy(preset: str, options: dict[str, Any], tmp_path: Path) -> None:
    small = {
        "critic_sizes": "16,16", "policy_sizes": "16,16", "batch_rows": 32, "replay_rows": 1000,
        "warm_up_steps": 20, "send_every_steps": 10, "lead_steps": 10,
    }  # fmt: skip
    hyper = off_policy(preset, {**small, **options})
    ledger = Ledger(tmp_path / "segments.log")
    run = RunConfig(env="Test-v0", variant="off-policy", seed=7)
    trainer, replay = make_off_policy(
        run, SPACES, hyper, tmp_path, ledger, {}, LearnerMetrics(), None
    )
    play(trainer, replay, LARGEST | {"suggestion": replay.max_suggestion})
    assert trainer.updates > 20
