"""Traits that make no difference: what is learned is the same to the bit as without them."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from a2s_case_processes import STEPS_OF_ALL_WAYS
from case_runs import A2S, SMALL, Trained, events, train
from system_helpers import FAST, PATIENCE_S, Command, Start, metrics_port, scrape

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
CONTROL = "a2s_case_envs:Control-v0"


@pytest.fixture(scope="module")
def control(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run of the environment without a trait."""
    return train(tmp_path_factory.mktemp("control"), CONTROL, *SMALL)


def _returns(trained: Trained) -> list[float]:
    return [float(episode["return"]) for episode in trained.episodes()]


@pytest.mark.long
def test_an_environment_with_one_buffer_an_old_interface_and_another_directory(
    control: Trained, tmp_path: Path
) -> None:
    """And the run, given by a relative path, is where it was asked for."""
    there = tmp_path / "there"
    trained = train(
        tmp_path, "a2s_case_envs:Tolerated-v0", "--env-kwargs", f"there={there}", *SMALL
    )
    assert trained.learned() == control.learned()
    assert trained.summary["evaluation"] == control.summary["evaluation"]
    assert list(there.iterdir()) == []
    lines = trained.actors_log().splitlines()
    assert len([line for line in lines if "seed" in line]) == 1
    assert [line for line in lines if "close raised RuntimeError: there is nothing to" in line]


@pytest.mark.long
def test_prints_of_every_kind(control: Trained, tmp_path: Path) -> None:
    """They are in the log, with the number of the worker."""
    trained = train(tmp_path, "a2s_case_processes:Noisy-v0", *SMALL)
    assert trained.learned() == control.learned()
    assert trained.summary["evaluation"] == control.summary["evaluation"]
    lines = set(trained.actors_log().splitlines())
    for words in (
        "a word of the import", "a word of the constructor", "an episode begins", "step 1",
        "step 470", "a word of C", "a word of a child", "[1, 2]", "a word of the error output",
        "after a long line",
    ):  # fmt: skip
        assert f"worker 0: {words}" in lines, words
    assert trained.summary["env_steps"] / 2 > STEPS_OF_ALL_WAYS
    assert "no end of a line" in trained.actors_log()


@pytest.mark.long
@pytest.mark.parametrize("closed", ["before it starts", "by its reader"])
def test_prints_without_a_place_to_go(
    start: Start, endpoint: str, tmp_path: Path, wait_for: WaitFor, closed: str
) -> None:
    """The actor's standard error is closed; its metrics are those of its workers."""
    options = ("--total-steps", "1500", "--listen", endpoint, "--run-dir", "run")
    learner = start("learner", "--env", "a2s_case_processes:Noisy-v0", *FAST, *options)
    words = [*A2S, "actor", "--n", "1", "--connect", endpoint, "--metrics-port", "0"]
    if closed == "before it starts":
        words = ["sh", "-c", 'exec "$@" 2>&-', "sh", *words]
    with (tmp_path / "actor.log").open("wb") as out:
        actor = subprocess.Popen(words, cwd=tmp_path, stdout=out, stderr=subprocess.PIPE)
    assert actor.stderr is not None
    actor.stderr.close()
    try:
        assert learner.process.wait(PATIENCE_S) == 0, learner.text()
        assert events(tmp_path / "run", "restart") == []
        port = metrics_port(Command(actor, tmp_path / "actor.log"))
        steps = 'a2s_actor_env_steps_total{worker="0"}'
        wait_for(lambda: scrape(port)[steps] >= 1500, "all steps to be counted")
    finally:
        actor.terminate()
        actor.wait(PATIENCE_S)
    assert actor.returncode == 143


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [("scale=9.5367431640625e-07",), ("dtype=float64", "offset=100000000.0")],
    ids=["tiny", "far from zero in float64"],
)
def test_observations_of_another_scale_are_learned_from_alike(
    control: Trained, tmp_path: Path, options: tuple[str, ...]
) -> None:
    kwargs = [word for option in options for word in ("--env-kwargs", option)]
    trained = train(tmp_path, CONTROL, *kwargs, *SMALL)
    assert np.allclose(_returns(trained), _returns(control), rtol=0.02)
    assert len(set(_returns(trained))) == len(_returns(control))
