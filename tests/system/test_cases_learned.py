"""Whole runs of environments with unusual numbers: they end with their steps, and say what was."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from case_runs import OFF_POLICY, SMALL, events, train
from system_helpers import FAST, PATIENCE_S, Start, metrics_port, scrape

from a2s.learner.replay import directory
from a2s.learner.replay.episodes import StoredEpisodes

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]


def test_dropped_transitions_are_counted_and_said_everywhere(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """One observation in 97 is not a number; the run in lockstep ends with its steps."""
    env = "a2s_case_numbers:Broken-v0"
    options = ("--listen", endpoint, "--run-dir", "run", "--total-steps", "2500", "--n", "2")
    learner = start("learner", "--env", env, *FAST, *options, "--metrics-port", "-1")
    actor = start("actor", "--n", "2", "--connect", endpoint, "--metrics-port", "0")
    assert learner.process.wait(PATIENCE_S) == 0, learner.text()
    port = metrics_port(actor)
    said = f"environment {env}: observation 1 is nan"
    trouble = events(tmp_path / "run", "trouble")
    assert trouble
    assert all(said in str(event) for event in trouble)
    assert said in actor.text()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["env_steps"] >= 2500
    names = [
        f'a2s_actor_dropped_transitions_total{{reason="malformed",worker="{i}"}}' for i in "01"
    ]
    dropped = summary["dropped_transitions"]
    assert dropped >= 20  # 600 steps in each of four environments
    seen: list[float] = []

    def all_are_counted() -> bool:
        found = scrape(port)
        seen[:] = [found[name] for name in names]
        return bool(sum(seen) >= dropped)

    wait_for(all_are_counted, f"{dropped} dropped transitions, found {seen}")
    assert min(seen) > 0


@pytest.mark.long
def test_the_penalty_of_a_last_step_without_an_observation_is_in_the_replay(
    tmp_path: Path,
) -> None:
    trained = train(tmp_path, "a2s_case_numbers:BrokenEndTerminated-v0", *OFF_POLICY)
    ends = [e for e in trained.episodes() if e["terminated"] == "1"]
    assert ends
    assert {e["length"] for e in ends} == {"97"}
    assert trained.summary["dropped_transitions"] == 0
    stored = [e for e in StoredEpisodes(trained.path / "replay") if e.terminated]
    assert len(stored) == len(ends)
    assert all(e.reward[-1] == -10.0 for e in stored)
    assert directory.look_at(trained.path / "replay").live.stop == trained.summary["env_steps"]


@pytest.mark.long
def test_an_off_policy_run_takes_every_integer(tmp_path: Path) -> None:
    """And as often as the policy means them: zero is only the half of the middle."""
    notes = tmp_path / "actions"
    env = "a2s_case_numbers:Integers-v0"
    trained = train(tmp_path, env, "--env-kwargs", f"notes={notes}", *OFF_POLICY)
    seen = notes.read_text().split()
    assert len(seen) >= trained.summary["env_steps"]
    assert {action: seen.count(action) >= 20 for action in {*seen}} == dict.fromkeys(
        ("-1", "0", "1"), True
    )


@pytest.mark.long
def test_an_off_policy_run_keeps_within_float64_bounds(tmp_path: Path) -> None:
    """The environment fails otherwise; a fresh policy is often at a bound."""
    notes = tmp_path / "actions"
    env = "a2s_case_numbers:StrictThird-v0"
    trained = train(tmp_path, env, "--env-kwargs", f"notes={notes}", *OFF_POLICY)
    assert trained.events("restart") == []
    seen = [float(action) for action in notes.read_text().split()]
    assert len(seen) >= trained.summary["env_steps"]
    assert max(seen) == pytest.approx(1 / 3, abs=0.01)


@pytest.mark.long
def test_wide_observations_of_one_environment_are_trained_on(tmp_path: Path) -> None:
    """A batch of 2,100 steps is 34 MiB, and would be one segment."""
    batch = ("--set", "batch_steps=2100", "--set", "first_batch_steps=2100", "--envs", "1")
    options = ("--max-episode-steps", "900", "--total-steps", "2100", "--episodes", "1")
    trained = train(tmp_path, "a2s_case_numbers:Wide4096-v0", *SMALL, *batch, *options)
    assert trained.summary["updates"] == 1
    assert trained.summary["segments"]["accepted"] >= 3


@pytest.mark.long
def test_randomness_of_the_modules_repeats_with_the_seed(tmp_path: Path) -> None:
    """In the constructor, in reset and in step, of `random` and of numpy, in two actors."""
    env = "a2s_case_numbers:GlobalRandom-v0"
    one, two = (train(tmp_path, env, *SMALL, "--n", "2", run=name) for name in ("one", "two"))
    assert one.learned() == two.learned()
    for name in ("evaluation", "weights_sha256"):
        assert one.summary[name] == two.summary[name]
