"""What an environment does to its process: the cause of its end is told all the same."""

import os
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import psutil
import pytest
from a2s_case_processes import SPOILED

from a2s.actors.check import check
from a2s.actors.description import Describing
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import FaultyEnvironmentError

pytestmark = [pytest.mark.timeout(120), pytest.mark.slow]

# A parent that starts a child, says its number, and waits to be killed.
PARENT = """
import sys, time
from a2s.actors.children import Child
from a2s.protocol.env_config import EnvConfig
config = EnvConfig(env_id="a2s_case_processes:Hangs-v0", kwargs=sys.argv[1])
child = Child("a2s.actors.check", {"env": config.to_json()}, lambda _: None, lambda _: None)
while child.doing() is None or child.doing().call != "step" or child.doing().since_s < 1:
    time.sleep(0.05)
print(child.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("how", SPOILED)
def test_the_cause_is_told_whatever_was_spoiled_before(how: str) -> None:
    config = EnvConfig(env_id="a2s_case_processes:Spoils-v0", kwargs=f'{{"how": "{how}"}}')
    with pytest.raises(FaultyEnvironmentError) as error:
        check(config, lambda _: None)
    words = str(error.value)
    if how == "closes all descriptors":
        assert "its process ended by closing file descriptors that are not its own" in words
        return
    assert "step raised RuntimeError: here is why [31m!!!" in words
    assert "a2s_case_processes.py:" in words
    assert words.isprintable()
    assert len(words) < 700


@pytest.mark.parametrize("name", ["Forks", "ReadsArguments", "SlowResets"])
def test_what_simulators_do_on_their_own_is_no_fault(name: str) -> None:
    env_id = f"a2s_case_processes:{name}-v0"
    found = check(EnvConfig(env_id=env_id, timeout_s=1.0), lambda _: None)
    assert found["steps"] > 0


def test_an_environment_that_configures_logging_does_not_silence_our_lines() -> None:
    words: list[str] = []
    check(EnvConfig(env_id="a2s_case_processes:SilencesLogs-v0"), words.append)
    assert any("close raised RuntimeError: there is nothing to close" in w for w in words), words


def test_a_report_is_heard_though_words_before_it_take_long_to_pass_on() -> None:
    """As where the learner computes and the thread that reads has to wait."""
    busy = threading.Event()

    def wait_a_while(_: str) -> None:
        busy.wait(0.8)

    config = EnvConfig(env_id="a2s_case_processes:Noisy-v0")
    with closing(Describing(config, wait_a_while)) as describing:
        assert describing.result() is not None


def test_a_child_that_simulates_starts_no_other_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As glfw would, which comes with MuJoCo: it costs time, and speaks when it is killed."""
    starts = tmp_path / "starts"
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        f"out = open({str(starts)!r}, 'a', buffering=1)\n"
        "out.write('python\\n')\n"
        "sys.addaudithook(lambda e, a: e == 'subprocess.Popen' and out.write(f'{a[1][1:3]}\\n'))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    with closing(Describing(EnvConfig(env_id="Hopper-v5"), lambda _: None)) as describing:
        assert describing.result() is not None
    assert starts.read_text().splitlines() == ["python"]


def test_orphans_that_have_ended_are_not_kept_as_zombies() -> None:
    words: list[str] = []
    check(EnvConfig(env_id="a2s_case_processes:Daemons-v0"), words.append)
    assert {word for word in words if "zombies" in word} == {"0 zombies"}


def test_a_process_that_was_there_before_is_none_of_ours(tmp_path: Path) -> None:
    """A shell has started it, and has become this program."""
    note = tmp_path / "pid"
    code = (
        "from a2s.actors.check import check; from a2s.protocol.env_config import EnvConfig; "
        "check(EnvConfig(env_id='a2s_case_envs:Control-v0'), print)"
    )
    script = f'setsid sleep 600 & echo $! > {note}; exec {sys.executable} -c "$0"'
    subprocess.run(["sh", "-c", script, code], check=True, timeout=60)
    daemon = psutil.Process(int(note.read_text()))
    daemon.kill()  # it is still there


def test_a_flood_of_words_is_cut_and_counted() -> None:
    words: list[str] = []
    found = check(EnvConfig(env_id="a2s_case_processes:Flood-v0"), words.append)
    assert 1000 <= len(words) < 3000
    *_, last = (w for w in words if w.startswith("... "))
    hidden = int(last.split()[1].replace(",", ""))
    assert last == f"... {hidden:,} lines more within 10 s are not shown"
    assert hidden > 0.1 * 1000 * found["steps"]


def test_a_child_that_holds_the_interpreter_ends_after_its_parent_was_killed(
    tmp_path: Path,
) -> None:
    kwargs = f'{{"notes": "{tmp_path}", "plan": "step-holds-the-lock"}}'
    command = [sys.executable, "-c", PARENT, kwargs]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as parent:
        try:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
            left = [psutil.Process(child), *psutil.Process(parent.pid).children(recursive=True)]
        finally:
            parent.kill()
    _, alive = psutil.wait_procs(left, timeout=60)
    assert alive == []
