"""``a2s replay``: what it says of a replay, stored or served."""

import json
import socket
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from replay_oracle import ENV_ID

from a2s.learner.replay import directory
from a2s.learner.replay.remote import ServedReplay
from a2s.protocol.keys import Keys
from a2s.protocol.zenoh_bus import ZenohBus

Run = Callable[..., tuple[int, str, str]]


def test_a_stored_replay_is_described_and_sampled(stored: Path, a2s: Run) -> None:
    """By the run directory, or the replay in it."""
    for path in (stored, stored / "replay"):
        code, out, _ = a2s("replay", "info", path, "--json")
        assert (code, json.loads(out)) == (0, {
            "env": ENV_ID, "obs_size": 2, "action_size": 2, "capacity": 24, "transitions": 24,
            "begin": 3, "end": 27, "torn_records": 0,
        })  # fmt: skip
    sample = ("replay", "sample", stored, "--batch-size", 8, "--seed", 5, "--json")
    (code, first, _), again = a2s(*sample), a2s(*sample)
    assert (code, first) == again[:2] == (0, first)
    batch = json.loads(first)
    assert len(batch["row"]) == 8
    assert np.array_equal(np.array(batch["action"]), np.array(batch["obs"]) / 2)


def test_a_stored_replay_is_sampled_by_the_exponent_of_its_run(stored: Path, a2s: Run) -> None:
    """As its learner would: with 1, a priority of a million leaves little for the others."""
    replay = directory.open_existing(stored / "replay")
    replay.update_priorities(np.array([9]), np.array([1e6]))
    replay.close()
    shares = []
    for hyper in ("", "[hyper]\npriority_exponent = 1.0\n", "[hyper]\npriority_exponent = 0.0\n"):
        (stored / "config.toml").write_text(hyper)
        sample = ("replay", "sample", stored, "--batch-size", 4096, "--prioritised", "--json")
        shares.append(json.loads(a2s(*sample)[1])["row"].count(9) / 4096)
    # 24 rows; 10**3.6 beside 23 where the exponent is not known
    assert shares == pytest.approx([3981 / 4004, 1.0, 1 / 24], abs=0.001)


def test_a_served_replay_is_described_and_sampled_the_same(
    stored: Path, tmp_path: Path, a2s: Run
) -> None:
    """Over a real socket."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with closing(ZenohBus.listen(endpoint)) as bus:
        replay = directory.open_existing(stored / "replay")
        ServedReplay(bus, Keys("walk"), replay, generation=3).open()
        there = ("--connect", endpoint, "--run", "walk")
        found = json.loads(a2s("replay", "info", *there, "--json")[1])
        assert (found["begin"], found["end"], found["generation"]) == (3, 27, 3)
        sample = ("replay", "sample", *there, "--n-step", 3, "--prioritised", "-o", "batch.npz")
        assert "next_obs (256, 2)" in a2s(*sample)[1]
        with np.load(tmp_path / "batch.npz") as arrays:
            assert arrays["obs"].shape == (256, 2)
            assert arrays["row"].min() >= 3
        code, _, error = a2s("replay", "info", "--connect", endpoint)
        assert code == 1
        assert "a2s/2/default/replay/info: no answer" in error
        replay.close()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["info"], 2, "name a run directory, or a learner with --connect"),
        (["info", "x", "--connect", "tcp/127.0.0.1:1"], 2, "found both x and tcp/127.0.0.1:1"),
        (["info", "x"], 1, "x: holds no replay"),
        (["sample", "x"], 1, "x: holds no replay"),
        (["info", "--connect", "tcp/127.0.0.1:1"], 1, "no learner at tcp/127.0.0.1:1"),
    ],
)
def test_a_mistake_gets_one_line(arguments: list[str], code: int, said: str, a2s: Run) -> None:
    """And the exit code of its kind."""
    found, _, error = a2s("replay", *arguments)
    assert found == code
    assert said in error
    assert error.count("\n") == 1


def test_a_learner_that_the_environment_names_beside_a_directory_is_named(
    a2s: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("A2S_CONNECT", "tcp/127.0.0.1:1")
    code, _, error = a2s("replay", "info", "x")
    assert code == 2
    assert "tcp/127.0.0.1:1, from --connect or A2S_CONNECT" in error
