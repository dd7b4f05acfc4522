"""``a2s tune``: what may be tried, and a search that goes on where it was."""

import threading
import tomllib
from pathlib import Path

import pytest
from system_helpers import FAST, REACH

from a2s.commands.tune import ON_POLICY, Range, Search, default_space, line, parse_range, tune
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.protocol.errors import UsageError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("gamma=0.9..0.99", Range("gamma", low=0.9, high=0.99)),
        ("lr=1e-4..1e-2:log", Range("lr", low=1e-4, high=1e-2, log=True)),
        ("q_steps=50..400", Range("q_steps", low=50, high=400, whole=True)),
        ("std=0..1.5", Range("std", low=0, high=1.5)),
        ("lr_rule=kl,anneal", Range("lr_rule", ("kl", "anneal"))),
        ("norm_obs=true,false", Range("norm_obs", ("true", "false"))),
    ],
)
def test_what_may_be_tried_is_read(text: str, expected: Range) -> None:
    assert parse_range(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "gamma",
        "gamma=",
        "=1,2",
        "gamma=1..",
        "gamma=1..0",
        "gamma=0..1:log",
        "a=b..c",
        "a=0..inf",
        "a=1,,2",
        "a=1",
    ],
)
def test_what_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"expected KEY=LOW..HIGH, KEY=LOW..HIGH:log or"):
        parse_range(text)


def test_the_usual_space_has_the_default_of_every_name_and_a2c_no_q() -> None:
    default = OnPolicyConfig()
    for each in map(parse_range, ON_POLICY):
        value = getattr(default, each.name)
        assert str(value) in each.choices if each.choices else each.low <= value <= each.high
    names = {parse_range(text).name for text in default_space(None, "a2c")}
    assert names == {parse_range(text).name for text in ON_POLICY} - {
        "suggestions",
        "pull_least_share",
    }


def _search(path: Path, *space: str) -> Search:
    settings = [word for word in FAST if "=" in word]
    options = {"env": REACH[1], "total_steps": 512, "envs": 2}
    words = [*REACH, "--total-steps", "512", "--envs", "2"]
    return Search(path, words, options, settings, [parse_range(text) for text in space])


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (("nothing=1,2",), "unknown hyperparameter 'nothing'"),
        (("gamma=0.9..1.5",), "gamma: found 1.5"),
        (("q_steps=1,none",), "q_steps: found 'none'"),
        (("gamma=0.9,1", "gamma=0.5..0.6"), "found gamma twice"),
        (("batch_steps=256,512",), "found batch_steps twice, expected once; --set counts"),
    ],
)
def test_an_impossible_space_is_refused_before_anything_is_made(
    tmp_path: Path, space: tuple[str, ...], words: str
) -> None:
    search = _search(tmp_path / "tune", *space)
    with pytest.raises(UsageError, match=words):
        tune(search, trials=1, parallel=1, seed=0, stop=threading.Event())
    assert not (tmp_path / "tune").exists()


def test_whole_numbers_are_tried_where_a_hyperparameter_is_one(tmp_path: Path) -> None:
    search, steps = _search(tmp_path, "q_steps=1e2..4e2", "gamma=0.5..1").checked()
    assert [each.whole for each in search.space] == [True, False]
    assert steps == 512


@pytest.mark.system
@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_search_goes_on_and_leaves_the_best_configuration(tmp_path: Path) -> None:
    """The second call makes one trial more, and a third none."""
    search = _search(tmp_path / "tune", "learning_rate=1e-4..1e-3:log", "suggestions=1,4")
    stopped = threading.Event()
    stopped.set()
    assert tune(search, trials=2, parallel=1, seed=0, stop=stopped) == {}
    for trials in (1, 2, 2):
        found = tune(search, trials=trials, parallel=1, seed=0, stop=threading.Event())
        assert (found["trials"], found["pruned"]) == (trials, 0)
    other = _search(tmp_path / "tune", "learning_rate=1e-4..1e-2:log")
    with pytest.raises(UsageError, match=r"has another search: found .* name another"):
        tune(other, trials=3, parallel=1, seed=0, stop=threading.Event())
    best = tomllib.loads((tmp_path / "tune" / "best.toml").read_text())
    assert str(best["hyper"]["suggestions"]) == found["best"]["suggestions"]
    assert best["hyper"]["batch_steps"] == 256
    assert best["run"]["evaluate_every"] == 0
    assert line(found).endswith(f"a2s train --config {tmp_path / 'tune' / 'best.toml'}")
