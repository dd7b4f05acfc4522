"""``a2s replay import``: what becomes prior data, and what is refused."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from replay_oracle import SPACES
from segments import segment

from a2s.learner.replay import directory
from a2s.learner.replay.replay import Replay
from a2s.protocol.fields import Spaces

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import minari
    from minari.data_collector import EpisodeBuffer

Run = Callable[..., tuple[int, str, str]]
COLUMNS = ("obs", "action", "reward", "next_obs", "discount")
UNIT = Spaces(obs_size=2, action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32))


def drawn(path: Path, *, n_step: int = 1) -> dict[str, Any]:
    """The same rows of every replay of the same size, in any order of their numbers."""
    batch = directory.look_at(path).sample(500, np.random.default_rng(0), n_step=n_step)
    return {name: getattr(batch, name) for name in COLUMNS}


def same(one: dict[str, Any], two: dict[str, Any]) -> bool:
    """Whether they are equal to the bit."""
    return all(np.array_equal(one[name], two[name]) for name in COLUMNS)


@pytest.fixture
def whole(tmp_path: Path) -> Callable[[Spaces], Path]:
    """Make a run directory with two whole episodes of six and of four steps, in two parts each."""

    def made(about: Spaces) -> Path:
        replay: Replay = directory.create(tmp_path / "run" / "replay", "Test-v0", about, 20)
        for seq, (steps, length, ends) in enumerate(((4, 4, ""), (2, 6, "terminated"),
                                                     (1, 1, ""), (3, 4, "truncated"))):  # fmt: skip
            last = {} if not seq % 2 else {"obs": _going_on(replay, seq, steps)}
            replay.insert(
                segment(
                    seq, steps, action_size=2, episode_length=length,
                    terminated=ends == "terminated", truncated=ends == "truncated", **last,
                )
            )  # fmt: skip
        replay.close()
        return tmp_path / "run"

    return made


def _going_on(replay: Replay, seq: int, steps: int) -> Any:
    """Observations of which the first is the last one before, as of one episode."""
    obs = np.random.default_rng(seq).standard_normal((steps, 2)).astype(np.float32)
    obs[0] = 0.0  # the final one of every segment
    return obs


DataSet = Callable[..., Path]


@pytest.fixture
def data_set(tmp_path: Path) -> DataSet:
    """Make a Minari data set of one episode of three steps, with these changes."""

    def made(observation_space: Any = None, action_space: Any = None, **changes: Any) -> Path:
        box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        values = {
            "observations": np.arange(8.0).reshape(4, 2), "actions": np.zeros((3, 1), np.float32),
            "rewards": [1.0, 2.0, 3.0], "terminations": [False, False, True],
            "truncations": [False] * 3,
        } | changes  # fmt: skip
        with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
            warnings.simplefilter("ignore")
            patch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
            minari.create_dataset_from_buffers(
                dataset_id="by-hand-v0",
                buffer=[EpisodeBuffer(id=0, **values)],
                observation_space=observation_space or box,
                action_space=action_space or spaces.Box(-2.0, 1.0, (1,), np.float32),
            )
        return tmp_path / "minari" / "by-hand-v0"

    return made


def test_the_replay_of_a_run_is_taken_as_it_is(stored: Path, a2s: Run, tmp_path: Path) -> None:
    """With lost segments and evicted rows, over any number of steps; and it says what it is."""
    code, out, _ = a2s("replay", "import", stored, "-o", "prior")
    assert (code, out) == (0, f"prior: 24 transitions of a2s_test_envs:Count-v0 from {stored}\n")
    for n_step in (1, 3):
        found, expected = (
            drawn(path, n_step=n_step) for path in (tmp_path / "prior", stored / "replay")
        )
        assert same(found, expected)
    said = json.loads(a2s("replay", "info", "prior", "--json")[1])
    assert (said["transitions"], said["source"]) == (24, str(stored))
    about = directory.look_at(tmp_path / "prior").about
    assert about.spaces.differs_from(SPACES) == ""


def test_the_last_ones_are_kept_and_named_as_the_run_names_them(
    stored: Path, a2s: Run, tmp_path: Path
) -> None:
    """The last five of the oracle's: two of an episode with a gap before it, three, and one."""
    found = json.loads(
        a2s("replay", "import", stored, "-o", "p", "--limit", 5, "--env", "X-v0", "--json")[1]
    )
    assert (found["transitions"], found["env"], found["obs_size"]) == (5, "X-v0", 2)
    assert found["action_low"] == [-1.0, 0.5]
    whole_one, kept = directory.look_at(stored / "replay"), directory.look_at(tmp_path / "p")
    newest = whole_one.obs_since(whole_one.live.stop - 5)
    assert np.array_equal(kept.obs_since(0), newest)


def test_what_was_exported_to_minari_comes_back_to_the_bit(
    whole: Callable[[Spaces], Path], a2s: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its directory, and by its name; the environment has to be named if Gymnasium has none."""
    run = whole(UNIT)
    code, out, error = a2s("replay", "export", run, "ten-v0", "--root", "minari", "--json")
    assert (code, json.loads(out)["steps"]) == (0, 10), error
    code, _, error = a2s("replay", "import", "minari/ten-v0", "-o", "prior")
    assert (code, error) == (
        2, "a2s: minari/ten-v0: does not say its environment; name it with --env\n"
    )  # fmt: skip
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    for source, output in (("minari/ten-v0", "one"), ("ten-v0", "two")):
        code, _, error = a2s("replay", "import", source, "-o", output, "--env", "Test-v0")
        assert code == 0, error
        for n_step in (1, 4):
            found, expected = (
                drawn(path, n_step=n_step) for path in (tmp_path / output, run / "replay")
            )
            assert same(found, expected)
    again = json.loads(a2s("replay", "export", "two", "again-v0", "--root", "minari", "--json")[1])
    assert (again["episodes"], again["left_out"]) == (2, 0)


def test_actions_come_back_as_they_were_executed(
    whole: Callable[[Spaces], Path], a2s: Run, tmp_path: Path
) -> None:
    """Bounds of -1 to 3 and 0.5 to 0.75 cost a rounding each way."""
    run = whole(SPACES)
    a2s("replay", "export", run, "ten-v0", "--root", "minari")
    a2s("replay", "import", "minari/ten-v0", "-o", "prior", "--env", "Test-v0")
    found, expected = drawn(tmp_path / "prior"), drawn(run / "replay")
    np.testing.assert_allclose(found.pop("action"), expected.pop("action"), atol=1e-6)
    assert all(np.array_equal(found[name], expected[name]) for name in found)


def test_a_data_set_is_read_by_hand(data_set: DataSet, a2s: Run, tmp_path: Path) -> None:
    """Parts of an observation in the order of the space; 1 of -2 to 1 is 1, -0.5 is 0."""
    box = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    path = data_set(
        observation_space=spaces.Dict({"b": box, "a": box}),
        observations={"b": np.arange(4.0)[:, None], "a": np.full((4, 1), 9.0)},
        actions=np.array([[1.0], [-0.5], [-2.0]], np.float32),
    )
    assert a2s("replay", "import", path, "-o", "prior", "--env", "Test-v0")[0] == 0
    batch = directory.look_at(tmp_path / "prior").sample(99, np.random.default_rng(0), gamma=0.5)
    rows = {
        tuple(map(float, (*obs, *action, reward, *next_obs, discount)))
        for obs, action, reward, next_obs, discount in zip(
            *(getattr(batch, name) for name in COLUMNS), strict=True
        )
    }
    assert rows == {
        (9.0, 0.0, 1.0, 1.0, 9.0, 1.0, 0.5),
        (9.0, 1.0, 0.0, 2.0, 9.0, 2.0, 0.5),
        (9.0, 2.0, -1.0, 3.0, 9.0, 3.0, 0.0),  # terminated
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"observations": np.array([[0, 0], [0, np.nan], [0, 0], [0, 0]])},
            "episode 0: obs: found nan, expected at most 1e+10 in size; leave it out",
        ),
        ({"rewards": [1.0, np.inf, 1.0]}, "episode 0: reward: found inf, expected at most 1e+10"),
        (
            {"actions": np.array([[0.0], [1.5], [0.0]], np.float32)},
            "episode 0: action 0 of step 1: found 1.5, expected -2 to 1; leave it out",
        ),
        ({"actions": np.full((3, 1), np.nan, np.float32)}, "of step 0: found nan, expected -2 to"),
        (
            {"observations": np.zeros((3, 2))},
            "episode 0: observations: found shape (3, 2), expected 4 of 2 numbers",
        ),
        (
            {"terminations": [True, False, True]},
            "episode 0: found an end before its last step, expected one at its end",
        ),
        (
            {"action_space": spaces.Discrete(2), "actions": np.zeros(3, np.int64)},
            "found actions Discrete(2), expected a Box; name another data set",
        ),
        (
            {"action_space": spaces.Box(-np.inf, np.inf, (1,), np.float32)},
            "action_low: found 1 non-finite values, expected finite numbers",
        ),
        (
            {"observation_space": spaces.Discrete(9), "observations": np.zeros(4, np.int64)},
            "observations: found Discrete(9), expected a Box, or a Dict of them",
        ),
    ],
)
def test_what_cannot_be_learned_from_is_one_line_and_nothing_is_left(
    data_set: DataSet, a2s: Run, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    path = data_set(**changes)
    code, _, error = a2s("replay", "import", path, "-o", "prior", "--env", "Test-v0")
    assert code == 2
    assert error.startswith(f"a2s: {path}: ")
    assert said in error
    assert error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["minari"]


def test_a_source_that_is_none_is_one_line(
    stored: Path, a2s: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "empty").mkdir()
    replay = directory.open_existing(stored / "replay")
    (tmp_path / "broken" / "data").mkdir(parents=True)
    (tmp_path / "broken" / "data" / "metadata.json").write_text("{}")
    for source, output, code, said in (
        ("nowhere-v0", "p", 2, "found neither a directory nor a Minari data set of this name"),
        ("no/such place", "p", 2, "no/such place: "),
        ("empty", "p", 1, "empty: holds no replay"),
        ("broken", "p", 2, "broken: cannot be read as a Minari data set ("),
        (stored, "empty", 2, "empty: is there already; name another with -o"),
        (stored, "p", 1, "a learner writes to it; stop it first, or, to learn from it meanwh"),
    ):
        found, _, error = a2s("replay", "import", source, "-o", output)
        assert (found, error.count("\n")) == (code, 1), error
        assert said in error
    replay.close()
    assert not (tmp_path / "p").exists()
