"""Event files: what TensorBoard reads, under the names of Stable-Baselines3."""

import struct
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from a2s.learner.run.run_config import RunConfig
from a2s.learner.run.status import Score, Status
from a2s.learner.run.tensorboard import FOLDER, Board


def _read(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Every scalar, by hand: records of a length, its checksum, an event, its checksum.

    As TensorBoard does, what is there from the step on at which a later file starts is dropped.
    """
    found = dict[str, list[tuple[int, float]]]()
    for file in sorted((path / FOLDER).iterdir()):
        data = file.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + size])
            if event.session_log.status == SessionLog.START:
                found = {tag: [x for x in found[tag] if x[0] < event.step] for tag in found}
            for value in event.summary.value:
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
            data = data[16 + size :]
    return found


def test_on_policy_updates_episodes_and_evaluations_are_written(tmp_path: Path) -> None:
    status = Status(RunConfig(), env_steps=2048, updates=1)
    board = Board(tmp_path, "on-policy")
    row = {"kl": 0.5, "entropy": 1.5, "learning_rate": 0.25, "value_loss": float("nan")}
    board.update(row, status)
    status.episodes.add(10.0, 4, {"is_success": 1.0})
    status.episodes.add(30.0, 8, {"is_success": 0.0})
    status.env_steps, status.updates = 4096, 2
    status.evaluated(Score(3000, 77.0, 1.0))
    for _ in range(2):
        board.update({}, status)
    board.close()
    found = _read(tmp_path)
    assert found["train/approx_kl"] == [(2048, 0.5)]
    assert found["train/entropy_loss"] == [(2048, -1.5)]
    assert found["train/learning_rate"] == [(2048, 0.25)]
    assert "train/value_loss" not in found
    assert found["rollout/ep_rew_mean"] == [(4096, 20.0)] * 2
    assert found["rollout/ep_len_mean"] == [(4096, 6.0)] * 2
    assert found["rollout/success_rate"] == [(4096, 0.5)] * 2
    assert found["eval/mean_reward"] == [(3000, 77.0)]
    assert found["train/n_updates"] == [(2048, 1.0), (4096, 2.0), (4096, 2.0)]


def test_off_policy_names_are_those_of_sac(tmp_path: Path) -> None:
    board = Board(tmp_path, "off-policy")
    row = {"policy_loss": 1.0, "q_loss": 2.0, "temperature": 0.5, "entropy": 3.0}
    board.update(row, Status(RunConfig(), env_steps=7))
    board.close()
    found = {tag: value for tag, ((_, value),) in _read(tmp_path).items()}
    assert found.pop("time/fps") == pytest.approx(0.0, abs=1e12)
    assert found == {
        "train/actor_loss": 1.0, "train/critic_loss": 2.0, "train/ent_coef": 0.5,
        "train/n_updates": 0.0,
    }  # fmt: skip


def test_a_run_that_goes_on_has_no_step_twice(tmp_path: Path) -> None:
    """Killed after 3,000 steps, it learns again from those after its checkpoint at 2,000.

    An evaluation at a step that was made is not made again.
    """
    first, scores = Board(tmp_path, "off-policy"), []
    for step in (1000, 2000, 3000):
        status = Status(RunConfig(), env_steps=step)
        scores += [Score(step, 0.5, 0.0), Score(step + 500, 0.25, 0.0)]
        for score in scores[-2:]:
            status.evaluated(score)
            first.update({"q_loss": 1.0}, status)
    first.close()
    (file,) = (tmp_path / FOLDER).iterdir()
    file.rename(file.with_name("0"))  # names have seconds
    again, status = Board(tmp_path, "off-policy", 2000, scores), Status(RunConfig())
    status.evaluated(scores[-1])
    for step in (3000, 4000):
        status.env_steps = step
        again.update({"q_loss": 2.0}, status)
    again.close()
    found = _read(tmp_path)
    losses = [(1000, 1.0), (1000, 1.0), (2000, 1.0), (2000, 1.0), (3000, 2.0), (4000, 2.0)]
    assert found["train/critic_loss"] == losses
    assert found["eval/mean_reward"] == [(each.env_steps, each.mean) for each in scores]
