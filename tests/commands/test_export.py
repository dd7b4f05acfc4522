"""``a2s replay export``: whole episodes of a replay as a Minari data set."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import pytest
import torch
from a2s_test_envs import Count
from replay_oracle import ENV_ID, SPACES, make_segment

from a2s.commands.minari_export import executed, room_of
from a2s.learner.export.off_policy import export as write_graph
from a2s.learner.off_policy.update import OffPolicy
from a2s.learner.replay import directory
from a2s.learner.replay.episodes import StoredEpisodes
from a2s.learner.run.config import off_policy
from a2s.protocol.fields import Spaces

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Minari, which keeps its data sets in ``tmp_path / "sets"``."""
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    return pytest.importorskip("minari")


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


def test_what_to_install_is_said_in_the_help_and_where_it_is_missing(
    stored: Path, a2s: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the help, brackets would be markup."""
    assert "Needs a2s[minari]." in a2s("replay", "export", "--help")[1]
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "h5py" else object()
    )
    code, _, error = a2s("replay", "export", stored, "x-v0")
    assert code == 2
    assert "pip install 'a2s[minari]'" in error


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


def test_minari_opens_what_is_exported(stored: Path, a2s: Run, minari: Any) -> None:
    """Every number as it was, actions in the units of the environment."""
    export = ("replay", "export", stored, "a2s/count-v0", "--json")
    said = json.loads(a2s(*export)[1])
    assert (said["episodes"], said["steps"], said["left_out"]) == (3, 14, 3)
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
    code, _, error = a2s(*export)
    assert code == 2
    assert "already exists" in error


def test_an_environment_that_was_registered_by_class_is_made_from_its_data_set(
    stored: Path, a2s: Run, minari: Any
) -> None:
    """By the name of the class."""
    assert gymnasium.spec("Count-v0").entry_point is Count
    assert a2s("replay", "export", stored, "count-v0")[0] == 0
    dataset = minari.load_dataset("count-v0")
    assert dataset.spec.env_spec.entry_point == "a2s_test_envs:Count"
    assert type(dataset.recover_environment().unwrapped) is Count


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
    stored: Path, a2s: Run, minari: Any, env_id: str, why: str
) -> None:
    """The data set is whole without it."""
    file = stored / "replay" / "replay.json"
    file.write_text(file.read_text().replace(ENV_ID, env_id))
    code, out, _ = a2s("replay", "export", stored, "count-v0")
    _, line = out.splitlines()
    assert code == 0
    assert line.startswith(f"the environment's spec is not kept in it: {why}")
    dataset = minari.load_dataset("count-v0")
    assert (dataset.total_steps, dataset.spec.env_spec) == (14, None)


@pytest.mark.parametrize(("root", "variable"), [(("--root", "sets"), "elsewhere"), ((), "sets")])
def test_a_root_may_be_relative(
    stored: Path,
    tmp_path: Path,
    a2s: Run,
    minari: Any,
    monkeypatch: pytest.MonkeyPatch,
    root: tuple[str, ...],
    variable: str,
) -> None:
    """As an option or a variable. Minari itself leaves half a data set there."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", variable)
    assert a2s("replay", "export", stored, "count-v0", *root)[0] == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    assert minari.load_dataset("count-v0").total_episodes == 3


@pytest.mark.parametrize("name", ["count", "../count-v0", "a2s/", "a b-v0", "count-v0/", ""])
@pytest.mark.usefixtures("minari")
def test_a_bad_name_of_a_data_set_is_refused_before_anything_is_made(
    stored: Path, tmp_path: Path, a2s: Run, name: str
) -> None:
    code, _, error = a2s("replay", "export", stored, name)
    assert (code, error.count("\n")) == (2, 1)
    assert f"found name {name!r}, expected one such as hopper-v0" in error
    assert not (tmp_path / "sets").exists()


@pytest.mark.usefixtures("minari")
def test_a_root_that_is_a_file_gets_one_line(stored: Path, tmp_path: Path, a2s: Run) -> None:
    (tmp_path / "sets").write_text("a file")
    code, _, error = a2s("replay", "export", stored, "count-v0")
    assert (code, error.count("\n")) == (2, 1)
    assert "count-v0: Not a directory; name another" in error


@pytest.mark.usefixtures("minari")
def test_an_export_without_room_gets_one_line_and_leaves_nothing(
    stored: Path, tmp_path: Path, a2s: Run, no_room: Callable[[], AbstractContextManager[None]]
) -> None:
    """HDF5 itself would crash."""
    root, export = tmp_path / "sets", ("replay", "export", stored, "count-v0")
    with no_room():
        code, _, error = a2s(*export)
    assert (code, error.count("\n")) == (1, 1)
    assert "sets: File too large, 0.0 MiB are needed" in error
    assert list(root.iterdir()) == []
    assert a2s(*export)[0] == 0
    written = (root / "count-v0" / "data" / "main_data.hdf5").stat().st_size
    assert written <= sum(map(room_of, StoredEpisodes(stored / "replay"))) <= 1.2 * written


@pytest.mark.usefixtures("minari")
def test_an_export_that_fails_at_its_end_gets_one_line_and_leaves_nothing(
    stored: Path, tmp_path: Path, a2s: Run
) -> None:
    """Where the namespace is to be there is a file; also after an export that was killed."""
    root = tmp_path / "sets"
    (root / ".a2s-count-v0.partial" / "a2s" / "count-v0").mkdir(parents=True)
    (root / "a2s").write_text("a file")
    code, _, error = a2s("replay", "export", stored, "a2s/count-v0")
    assert (code, error.count("\n")) == (1, 1)
    assert "sets/a2s/count-v0: " in error
    assert [path.name for path in root.iterdir()] == ["a2s"]
