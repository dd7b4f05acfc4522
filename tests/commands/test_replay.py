"""``a2s replay``: what it says of a replay, stored or served, and what it exports."""

import json
import socket
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import pytest
import torch
from a2s_test_envs import Count
from replay_oracle import ENV_ID, SPACES, Oracle, make_segment

from a2s import cli
from a2s.commands.minari_export import executed, room_of
from a2s.learner.export.off_policy import export as write_graph
from a2s.learner.off_policy.presets import off_policy
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.replay import directory
from a2s.learner.replay.episodes import StoredEpisodes
from a2s.learner.replay.remote import ServedReplay
from a2s.protocol.fields import Spaces
from a2s.protocol.keys import Keys
from a2s.protocol.zenoh_bus import ZenohBus


def run(*arguments: object, monkeypatch: pytest.MonkeyPatch) -> int:
    """Run the command line, and give its exit code."""
    monkeypatch.setattr(sys, "argv", ["a2s", "replay", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The only line on standard error."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A run directory with a replay of two streams, that have lost segments and evicted rows."""
    replay = directory.create(tmp_path / "run" / "replay", ENV_ID, SPACES, 24)
    oracle = Oracle(24)
    for actor, steps, end, lost in (
        ("a", 5, "", False),  # rows 0 to 4: evicted in part
        ("b", 2, "", False),
        ("a", 3, "terminated", False),  # its first step is no longer there
        ("a", 4, "", False),  # rows 10 to 13
        ("b", 3, "truncated", False),  # rows 14 to 16, after 5 and 6
        ("a", 2, "truncated", False),  # rows 17 and 18
        ("b", 2, "", False),
        ("b", 2, "", True),
        ("b", 2, "terminated", False),  # a segment is lost
        ("a", 3, "terminated", False),  # rows 23 to 25
        ("b", 1, "", False),  # not over
    ):
        segment = oracle.play(actor, 0, steps, end, lost=lost)
        if not lost:
            replay.insert(segment)
    assert replay.live == range(3, 27)
    replay.close()
    return tmp_path / "run"


def test_episodes_are_whole_or_left_out(stored: Path) -> None:
    """Whatever lay between their segments."""
    episodes = StoredEpisodes(stored / "replay")
    found = [(e.obs[:, 0].tolist(), e.terminated) for e in episodes]
    assert found == [
        ([1000.0, 1001.0, 1002.0, 1003.0, 1004.0, 1005.0], False),
        ([9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0], False),
        ([16.0, 17.0, 18.0, 19.0], True),
    ]
    assert episodes.left_out == 3
    for episode in episodes:
        assert np.array_equal(episode.action, episode.obs[:-1] / 2)
        assert np.array_equal(episode.reward, episode.obs[:-1, 0] / 2)


@pytest.mark.parametrize(
    ("later", "left_out"),
    [
        ({"before": 3, "end": "truncated"}, 1),  # its third step was lost
        ({"before": 2, "end": "truncated"}, 2),  # another: after two steps it was at 2, not at 7
        ({"before": 1}, 2),  # another, not over either
        ({"before": 0, "end": "terminated"}, 1),  # another, and whole
    ],
)
def test_an_episode_with_a_segment_lost_is_counted_once(
    tmp_path: Path, later: dict[str, Any], left_out: int
) -> None:
    """Unless what came later must be of another, of which the beginning was lost."""
    replay = directory.create(tmp_path, ENV_ID, SPACES, 100)
    replay.insert(make_segment([0.0, 1.0, 2.0], [1.0, 1.0], seq=0))
    replay.insert(make_segment([7.0, 8.0], [1.0], seq=2, **later))
    replay.close()
    episodes = StoredEpisodes(tmp_path)
    assert len(list(episodes)) == (later["before"] == 0)
    assert episodes.left_out == left_out


def test_rows_that_are_overwritten_while_we_read_are_left_out(stored: Path) -> None:
    """A learner may go on meanwhile."""
    episodes = StoredEpisodes(stored / "replay")
    replay = directory.open_existing(stored / "replay")
    for seq in range(60):
        replay.insert(make_segment([0.0, 1.0, 2.0], [7.0, 7.0], actor="c", seq=seq))
    replay.close()
    assert list(episodes) == []
    assert episodes.left_out == 6


def test_a_stored_replay_is_described_and_sampled(
    stored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the run directory, or the replay in it."""
    for path in (stored, stored / "replay"):
        assert run("info", path, "--json", monkeypatch=monkeypatch) == 0
        assert json.loads(capsys.readouterr().out) == {
            "env": ENV_ID, "obs_size": 2, "action_size": 2, "capacity": 24, "transitions": 24,
            "begin": 3, "end": 27, "torn_records": 0,
        }  # fmt: skip
    drawn = []
    for _ in range(2):
        arguments = ("sample", stored, "--batch-size", 8, "--seed", 5, "--json")
        assert run(*arguments, monkeypatch=monkeypatch) == 0
        drawn.append(capsys.readouterr().out)
    assert drawn[0] == drawn[1]
    batch = json.loads(drawn[0])
    assert len(batch["row"]) == 8
    assert np.array_equal(np.array(batch["action"]), np.array(batch["obs"]) / 2)


def test_a_stored_replay_is_sampled_by_the_exponent_of_its_run(
    stored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As its learner would: with 1, a priority of a million leaves little for the others."""
    replay = directory.open_existing(stored / "replay")
    replay.update_priorities(np.array([9]), np.array([1e6]))
    replay.close()
    shares = []
    for hyper in ("", "[hyper]\npriority_exponent = 1.0\n", "[hyper]\npriority_exponent = 0.0\n"):
        (stored / "config.toml").write_text(hyper)
        arguments = ("sample", stored, "--batch-size", 4096, "--prioritised", "--json")
        assert run(*arguments, monkeypatch=monkeypatch) == 0
        rows = json.loads(capsys.readouterr().out)["row"]
        shares.append(rows.count(9) / 4096)
    # 24 rows; 10**3.6 beside 23 where the exponent is not known
    assert shares == pytest.approx([3981 / 4004, 1.0, 1 / 24], abs=0.001)


def test_a_served_replay_is_described_and_sampled_the_same(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Over a real socket."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with closing(ZenohBus.listen(endpoint)) as bus:
        replay = directory.open_existing(stored / "replay")
        ServedReplay(bus, Keys("walk"), replay, generation=3).open()
        there = ("--connect", endpoint, "--run", "walk")
        assert run("info", *there, "--json", monkeypatch=monkeypatch) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["begin"], found["end"], found["generation"]) == (3, 27, 3)
        output = tmp_path / "batch.npz"
        arguments = ("sample", *there, "--n-step", 3, "--prioritised", "-o", output)
        assert run(*arguments, monkeypatch=monkeypatch) == 0
        assert "next_obs (256, 2)" in capsys.readouterr().out
        with np.load(output) as arrays:
            assert arrays["obs"].shape == (256, 2)
            assert arrays["row"].min() >= 3
        assert run("info", "--connect", endpoint, monkeypatch=monkeypatch) == 1
        assert "a2s/2/default/replay/info: no answer" in capsys.readouterr().err
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
def test_a_mistake_gets_one_line(
    arguments: list[str],
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And the exit code of its kind."""
    assert run(*arguments, monkeypatch=monkeypatch) == code
    assert said in one_line(capsys)


def test_a_learner_that_the_environment_names_beside_a_directory_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("A2S_CONNECT", "tcp/127.0.0.1:1")
    assert run("info", "x", monkeypatch=monkeypatch) == 2
    assert "tcp/127.0.0.1:1, from --connect or A2S_CONNECT" in capsys.readouterr().err


def test_the_help_of_export_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Brackets are markup to what shows it."""
    assert run("export", "--help", monkeypatch=monkeypatch) == 0
    assert "Needs a2s[minari]." in capsys.readouterr().out


def test_export_without_minari_says_what_to_install(
    stored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is an extra: nobody else needs it."""
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "h5py" else object()
    )
    assert run("export", stored, "x-v0", monkeypatch=monkeypatch) == 2
    assert "pip install 'a2s[minari]'" in capsys.readouterr().err


def test_actions_are_exported_as_the_graph_gave_them(rng: np.random.Generator) -> None:
    """To the bit, also where the bounds are no powers of two."""
    spaces = Spaces(
        obs_size=3,
        action_low=np.array([-0.4, -1.0, 0.5, -2.0], np.float32),
        action_high=np.array([0.4, 3.0, 0.75, 1.0], np.float32),
    )
    sizes = {"policy_sizes": "8", "critic_sizes": "8"}
    algorithm = OffPolicy(3, 4, off_policy("sac", sizes), 0, "cpu")
    bounds = torch.tensor(spaces.action_low), torch.tensor(spaces.action_high)
    graph = onnxruntime.InferenceSession(write_graph(algorithm.suggester(*bounds), 1, {}))
    obs = rng.standard_normal((4000, 3)).astype(np.float32)
    noise = rng.standard_normal((4000, 1, 4)).astype(np.float32)
    action, suggestion = graph.run(["action", "suggestion"], {"obs": obs, "normal": noise})
    assert np.array_equal(executed(suggestion, spaces), action)


def test_minari_opens_what_is_exported(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every number as it was, actions in the units of the environment."""
    minari: Any = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    root = tmp_path / "sets"
    arguments = ("export", stored, "a2s/count-v0", "--root", root)
    assert run(*arguments, "--json", monkeypatch=monkeypatch) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["episodes"], said["steps"], said["left_out"]) == (3, 14, 3)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    dataset = minari.load_dataset("a2s/count-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 14)
    for found, episode in zip(
        dataset.iterate_episodes(), StoredEpisodes(stored / "replay"), strict=True
    ):
        assert np.array_equal(found.observations, episode.obs)
        assert np.array_equal(found.rewards, episode.reward)
        assert found.terminations.tolist() == [False] * (len(found) - 1) + [episode.terminated]
        assert found.truncations.tolist() == [False] * (len(found) - 1) + [not episode.terminated]
        # -1 to 1 spans the bounds -1 to 3 and 0.5 to 0.75
        expected = np.clip(episode.action, -1, 1) * [2.0, 0.125] + [1.0, 0.625]
        assert np.allclose(found.actions, expected)
        assert all(dataset.action_space.contains(action) for action in found.actions)
    assert run(*arguments, monkeypatch=monkeypatch) == 2
    assert "already exists" in capsys.readouterr().err


def test_an_environment_that_was_registered_by_class_is_made_from_its_data_set(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the name of the class."""
    minari: Any = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    assert gymnasium.spec("Count-v0").entry_point is Count
    root = tmp_path / "sets"
    assert run("export", stored, "count-v0", "--root", root, monkeypatch=monkeypatch) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    dataset = minari.load_dataset("count-v0")
    assert dataset.spec.env_spec.entry_point == "a2s_test_envs:Count"
    made = dataset.recover_environment()
    assert type(made.unwrapped) is Count


def _rename(stored: Path, env_id: str) -> None:
    file = stored / "replay" / "replay.json"
    file.write_text(file.read_text().replace(ENV_ID, env_id))


@pytest.mark.parametrize(
    ("env_id", "why"),
    [
        ("a2s_test_envs:CountByFunction-v0", "it was registered with objects that cannot be"),
        ("a2s_test_envs:CountByArray-v0", "it was registered with objects that cannot be"),
        ("a2s_test_envs:NoSuch-v0", "Environment `NoSuch` doesn't exist"),
        ("no_such_module:Count-v0", "No module named 'no_such_module'"),
    ],
)
def test_an_environment_that_cannot_be_written_down_is_one_line(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    env_id: str,
    why: str,
) -> None:
    """The data set is whole without it."""
    minari: Any = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    _rename(stored, env_id)
    root = tmp_path / "sets"
    assert run("export", stored, "count-v0", "--root", root, monkeypatch=monkeypatch) == 0
    _, line = capsys.readouterr().out.splitlines()
    assert line.startswith(f"the environment's spec is not kept in it: {why}")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    dataset = minari.load_dataset("count-v0")
    assert (dataset.total_steps, dataset.spec.env_spec) == (14, None)


@pytest.mark.parametrize("how", ["option", "variable"])
def test_a_root_may_be_relative(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Minari itself leaves half a data set there."""
    minari: Any = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    root = ("--root", "sets") if how == "option" else ()
    monkeypatch.setenv("MINARI_DATASETS_PATH", "elsewhere" if how == "option" else "sets")
    assert run("export", stored, "count-v0", *root, monkeypatch=monkeypatch) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    assert minari.load_dataset("count-v0").total_episodes == 3


@pytest.mark.parametrize("name", ["count", "../count-v0", "a2s/", "a b-v0", "count-v0/", ""])
def test_a_bad_name_of_a_data_set_is_refused_before_anything_is_made(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    pytest.importorskip("minari")
    root = tmp_path / "sets"
    assert run("export", stored, name, "--root", root, monkeypatch=monkeypatch) == 2
    assert f"found name {name!r}, expected one such as hopper-v0" in one_line(capsys)
    assert not root.exists()


def test_a_root_that_is_a_file_gets_one_line(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("minari")
    root = tmp_path / "sets"
    root.write_text("a file")
    assert run("export", stored, "count-v0", "--root", root, monkeypatch=monkeypatch) == 2
    assert "count-v0: Not a directory; name another" in capsys.readouterr().err


def test_an_export_without_room_gets_one_line_and_leaves_nothing(
    stored: Path,
    tmp_path: Path,
    no_room: Callable[[], AbstractContextManager[None]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """HDF5 itself would crash."""
    pytest.importorskip("minari")
    root = tmp_path / "sets"
    arguments = ("export", stored, "count-v0", "--root", root)
    with no_room():
        assert run(*arguments, monkeypatch=monkeypatch) == 1
    assert "sets: File too large, 0.0 MiB are needed" in one_line(capsys)
    assert list(root.iterdir()) == []
    assert run(*arguments, monkeypatch=monkeypatch) == 0
    written = (root / "count-v0" / "data" / "main_data.hdf5").stat().st_size
    assert written <= sum(map(room_of, StoredEpisodes(stored / "replay"))) <= 1.2 * written


def test_an_export_that_fails_at_its_end_gets_one_line_and_leaves_nothing(
    stored: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Where the namespace is to be there is a file; also after an export that was killed."""
    pytest.importorskip("minari")
    root = tmp_path / "sets"
    left = root / ".a2s-count-v0.partial" / "a2s" / "count-v0"
    left.mkdir(parents=True)
    (root / "a2s").write_text("a file")
    arguments = ("export", stored, "a2s/count-v0", "--root", root)
    assert run(*arguments, monkeypatch=monkeypatch) == 1
    assert "sets/a2s/count-v0: " in one_line(capsys)
    assert [path.name for path in root.iterdir()] == ["a2s"]
