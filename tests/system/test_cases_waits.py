"""What is slow is waited for by its name, and what never ends is cut."""

import re
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from case_runs import SMALL, evaluate, events, train
from system_helpers import FAST, PATIENCE_S, Start

from a2s.protocol.codec import decode
from a2s.protocol.keys import Keys
from a2s.protocol.messages import RunStatus
from a2s.protocol.zenoh_bus import ZenohBus

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]


@pytest.mark.long
def test_who_is_slow_is_waited_for_by_name(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor
) -> None:
    """Nobody is told to start an actor while one is being made ready."""
    slow = ("--env-kwargs", "make_s=3", "--env-kwargs", "reset_s=3")
    options = ("--listen", endpoint, "--run-dir", "run", "--total-steps", "512", "--n", "1")
    learner = start("learner", "--env", "a2s_case_envs:Slow-v0", *slow, *FAST, *options)
    start("actor", "--n", "1", "--envs", "1", "--connect", endpoint, "--metrics-port", "-1")
    wait_for(lambda: "/metrics" in learner.text(), "the learner")
    waits: list[str] = []
    with closing(ZenohBus.connect(endpoint, lambda: learner.process.poll() is None)) as bus:

        def done() -> bool:
            reply = bus.ask(Keys("default").status, b"", 1.0)
            if reply is not None:
                status = decode(reply, RunStatus)
                if status.waiting_for and status.waiting_for not in waits:
                    waits.append(status.waiting_for)
            return learner.process.poll() is not None

        wait_for(done, "the end", timeout_s=PATIENCE_S)
    assert learner.process.returncode == 0, learner.text()
    named = [i for i, words in enumerate(waits) if " of environment 0" in words]
    assert any("make of environment 0 for" in words for words in waits), waits
    assert any("reset of environment 0 for" in words for words in waits), waits
    assert not [words for words in waits[named[0] :] if "a2s actor`" in words], waits
    events_of = [event["reason"] for event in events(tmp_path / "run", "restart")]
    assert events_of == []


@pytest.mark.long
def test_an_episode_that_never_ends_is_cut_in_evaluation_and_says_so(tmp_path: Path) -> None:
    """And its return of about -0.005 is told with digits."""
    kwargs = ("--env-kwargs", "length=0", "--env-kwargs", "reward_scale=1e-6")
    options = (*SMALL, "--total-steps", "512", "--episodes", "1")
    trained = train(tmp_path, "a2s_case_envs:Control-v0", *kwargs, *options)
    assert trained.episodes() == []
    assert "--max-episode-steps" in trained.err
    assert "10,000 steps" in trained.err
    mean = trained.summary["evaluation"]["mean"]
    assert -0.02 < mean < -0.001
    (line,) = (line for line in trained.err.splitlines() if line.startswith("evaluation: "))
    found = re.match(r"evaluation: (\S+) \+- ", line)
    assert found, line
    assert float(found[1]) == pytest.approx(mean, rel=0.01)
    cut = evaluate(tmp_path, "run", "--episodes", "3", "--max-episode-steps", "50")
    assert cut["lengths"] == [50, 50, 50]


@pytest.mark.long
def test_a_limit_of_the_users_own_is_kept_and_used_everywhere(tmp_path: Path) -> None:
    """Whole episodes are what the preset of the authors waits for; the class has no id."""
    env = ("a2s_case_envs:Control", "--env-kwargs", "length=0", "--max-episode-steps", "60")
    trained = train(tmp_path, *env, "--preset", "authors", *SMALL)
    episodes = trained.episodes()
    assert len(episodes) >= 16
    assert {(e["length"], e["terminated"]) for e in episodes} == {("60", "0")}
    assert "max_episode_steps = 60" in (trained.path / "config.toml").read_text()
    assert evaluate(tmp_path, "run", "--episodes", "3")["lengths"] == [60, 60, 60]
