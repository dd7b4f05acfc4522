"""What hangs, dies or cannot be closed is ended and replaced, and the run goes on."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from case_runs import SMALL, train
from system_helpers import FAST, PATIENCE_S, Start

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]


def test_what_hangs_is_replaced_and_named_and_the_run_goes_on(tmp_path: Path) -> None:
    """In a step, in one that lets no thread of Python run, in a reset; or it aborts or raises."""
    deeds = tmp_path / "deeds"
    deeds.mkdir()
    plan = "step-sleeps,step-holds-the-lock,reset-sleeps,step-aborts,step-raises"
    options = ("--env-kwargs", f"notes={deeds}", "--env-kwargs", f"plan={plan}")
    more = ("--n", "2", "--env-timeout", "3", "--total-steps", "4000", "--set", "critic_epochs=20")
    trained = train(tmp_path, "a2s_case_processes:Hangs-v0", *options, *SMALL, *more)
    assert {path.name for path in deeds.iterdir()} == {*plan.split(",")}
    assert trained.summary["env_steps"] >= 4000
    reasons = [event["reason"] for event in trained.events("restart")]
    name = "environment a2s_case_processes:Hangs-v0: "
    hung = [r for r in reasons if "had not returned after 3 s" in r]
    assert len(reasons) == 5
    assert sorted(r.split(" of ")[0] for r in hung) == [name + w for w in ("reset", "step", "step")]
    assert len([r for r in reasons if "SIGABRT" in r]) == 1, reasons
    assert len([r for r in reasons if "step raised ZeroDivisionError" in r]) == 1, reasons
    for reason in reasons:
        assert reason in trained.actors_log()
        assert reason in trained.err
    segments = trained.summary["segments"]
    assert segments["sent"] == sum(segments[k] for k in ("accepted", "stale", "refused", "lost"))


@pytest.mark.long
def test_who_dies_again_and_again_is_given_up_and_the_others_go_on(tmp_path: Path) -> None:
    """What it has done before does not count: only what it has done since its last death."""
    options = ("--env-kwargs", "worker={worker}", "--env-kwargs", f"notes={tmp_path}")
    more = ("--env-kwargs", "doomed=1", "--n", "2", "--total-steps", "40000")
    trained = train(tmp_path, "a2s_case_processes:Doomed-v0", *options, *SMALL, *more)
    assert trained.summary["env_steps"] >= 40_000
    said = "worker 1 died 5 times in a row before it had done any work; last: environment "
    assert said in trained.actors_log()
    assert "SIGABRT in step of environment 0; it is given up, the others go on" in (
        trained.actors_log()
    )
    assert len(trained.events("restart")) == 4


@pytest.mark.long
def test_a_close_that_never_returns_hinders_nobody(tmp_path: Path) -> None:
    options = ("--env-kwargs", "where=close", "--env-timeout", "2")
    trained = train(tmp_path, "a2s_case_processes:HangsAlways-v0", *options, *SMALL)
    assert "close of environment" in trained.actors_log()
    assert trained.events("restart") == []
    assert "evaluation" in trained.summary


@pytest.mark.long
def test_no_more_environments_are_open_at_once_than_one_actor_has(tmp_path: Path) -> None:
    """Each is a device until its process ends: the learner has looked at it, and gave it back."""
    options = ("--env-kwargs", f"notes={tmp_path}", "--env-kwargs", "places=1", "--envs", "1")
    trained = train(tmp_path, "a2s_case_processes:Places-v0", *SMALL, *options, "--episodes", "5")
    assert trained.summary["evaluation"]["episodes"] == 5


@pytest.mark.long
def test_ctrl_c_ends_a_training_whose_environment_hangs(
    start: Start, tmp_path: Path, wait_for: WaitFor
) -> None:
    """Long before the time that it would be given."""
    deeds = tmp_path / "deeds"
    deeds.mkdir()
    plan = "step-sleeps,step-holds-the-lock"
    options = ("--env-kwargs", f"notes={deeds}", "--env-kwargs", f"plan={plan}", *FAST)
    train = start("train", "--env", "a2s_case_processes:Hangs-v0", *options, "--n", "2")
    wait_for(lambda: len([*deeds.iterdir()]) == 2, "both to hang", timeout_s=PATIENCE_S)
    workers = train.workers()
    assert train.end(signal.SIGINT) == 130, train.text()
    assert not any(worker.is_running() for worker in workers)
