"""The command line: options and where they come from; mistakes get one line and exit code 2."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from a2s import __version__, cli
from a2s.protocol.errors import UsageError

Run = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["learner", "--env", "NoSuchThing-v5"], "NoSuchThing"),
        (["learner", "--env", "CartPole-v1"], "--env InvertedPendulum-v5 is like it"),
        (["learner", "--preset", "modem"], "did you mean 'modern'?"),
        (["learner", "--algo", "a3c"], "algo: found 'a3c', expected one of a2s, a2c"),
        (["learner", "--set", "gama=0.9"], "did you mean 'gamma'?"),
        (
            ["learner", "--variant", "off-policy", "--set", "buffer_size=1e6"],
            "unknown hyperparameter 'buffer_size' (here it is 'replay_rows')",
        ),
        (
            ["learner", "--set", "batch_size=64"],
            "unknown hyperparameter 'batch_size' (here it is 'policy_minibatch')",
        ),
        (
            ["learner", "--set", "total_timesteps=1e6"],
            "unknown hyperparameter 'total_timesteps' (here it is the option --total-steps)",
        ),
        (
            ["learner", "--variant", "off-policy", "--set", "batch_size=5"],
            "(here it is 'batch_rows')",
        ),
        (["learner", "--set", "gamma=1.5"], "gamma: found 1.5"),
        (["learner", "--set", "recovery_bias=nan"], "recovery_bias: found nan"),
        (["learner", "--set", "gamma"], "found 'gamma', expected KEY=VALUE"),
        (["learner", "--seed", "x"], "--seed or A2S_SEED: found 'x', expected a whole number"),
        (["learner", "--seed", "-1"], "--seed or A2S_SEED: found -1, expected 0 to 92233720368547"),
        (["learner", "--total-steps", "0e3"], "A2S_TOTAL_STEPS: found 0e3, expected at least 1"),
        (["learner", "--total-steps", "inf"], "found 'inf', expected a whole number such as 1000"),
        (["learner", "--total-steps", "1e999999999"], "found '1e999999999', expected a whole num"),
        (["learner", "--seed", str(10**22)], f"found {10**22}, expected 0 to {2**63 - 1}"),
        (["learner", "--metrics-port", "-2"], "found -2, expected -1 to 65535"),
        (["actor", "--n", "0"], "--n or A2S_N: found 0, expected at least 1"),
        (["bench", "wire", "--rounds", "0"], "--rounds: found 0, expected at least 1"),
        (["learner", "--suggestions", "0"], "suggestions: found 0"),
        (["learner", "--run", "a/b"], "run name: found 'a/b'"),
        (["learner", "--listen", "7447"], "expected PROTOCOL/HOST:PORT"),
        (["learner", "--device", "gpu"], "device: found 'gpu', expected one of cpu, cuda"),
        (["learner", "--device", "cuda"], "expected cpu with variant on-policy"),
        (["learner", "--variant", "off-policy", "--algo", "a2c"], "algo: found a2c, expected a2s"),
        (["learner", "--variant", "off-policy", "--recovery"], "only on-policy learning has"),
        (["train", "--variant", "off-policy", "--no-recovery"], "only on-policy learning has"),
        (["learner", "--prior", "x"], "/x, expected none with variant on-policy; add --variant"),
        (["learner", "--replay-from", "x", "--prior", "y"], "--prior: found with --replay-from"),
        (
            ["train", "--variant", "off-policy", "--prior-share", "0.25"],
            "prior_share: there are no prior data to draw from; add --prior",
        ),
        (
            ["train", "--variant", "off-policy", "--prior", "x", "--prior-share", "1"],
            "prior_share: found 1.0, expected a number from 0.01 to 0.99",
        ),
        (["learner", "--print-config", "--total-steps", "1e20"], "total_steps: found 10000000000"),
        (["learner", "--config", "missing.toml"], "missing.toml: No such file"),
        (["learner", "--resume"], "found no run 'default'"),
        (["learner", "--resume", "--run-dir", "nowhere"], "nowhere holds no config.toml"),
        (["actor", "--connect", "learner:7447"], "expected PROTOCOL/HOST:PORT"),
        (["actor", "--allow-env", "./none.py:Walk"], "found no file ./none.py"),
        (["actor", "--run", "*"], "run name: found '*'"),
        (["evaluate", "nowhere"], "No such file"),
        (["evaluate", ".", "--mode", "men"], "did you mean 'mean'?"),
        (["evaluate", ".", "--weights", "newest"], "--weights: found 'newest'"),
        (["plot", "nowhere"], "nowhere: is not a run directory"),
    ],
)
def test_a_mistake_gets_one_line(arguments: list[str], said: str, a2s: Run) -> None:
    code, _, error = a2s(*arguments)
    assert code == 2
    assert said in error
    assert error.startswith("a2s: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "--run-dir", "x" * 300],
        ["learner", "--replay-from", "x" * 300],
        ["learner", "--replay-journal", "x" * 300],
        ["actor", "--allow-env", "x" * 300 + ".py"],
        ["actor", "--tls", "x" * 300],
        ["certs", "x" * 300],
        ["doctor", "x" * 300],
    ],
    ids=lambda arguments: " ".join(arguments[:-1]),
)
def test_a_name_that_is_too_long_gets_one_line(arguments: list[str], a2s: Run) -> None:
    code, _, error = a2s(*arguments)
    assert code == 2
    assert re.fullmatch(r"a2s: x{300}\S*: File name too long; name a shorter one\n", error)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--env-kwargs", "novalue"), "--env-kwargs: found 'novalue'"),
        (("--env-kwargs", "=3"), "--env-kwargs: found '=3'"),
        (("--wrapper", "nocolon"), "--wrapper: found 'nocolon'"),
        (("--wrapper", "a2s_case_numbers:Shift={not json}"), "--wrapper: found 'a2s_case_numbers"),
        (("--wrapper", "a2s_case_numbers:NoSuchWrapper"), "NoSuchWrapper"),
        (("--wrapper", "no_such_module:Shift"), "--wrapper: no_such_module: No module named"),
        (("--wrapper", 'a2s_case_numbers:Shift={"beyond": 1}'), "beyond"),
        (("--action-repeat", "0"), "action-repeat"),
        (("--frame-stack", "0"), "frame-stack"),
        (("--max-episode-steps", "-1"), "max-episode-steps"),
        (("--env-timeout", "0"), "env-timeout"),
    ],
)
def test_an_option_that_the_environment_cannot_take_is_refused_with_its_name(
    options: tuple[str, str], said: str, a2s: Run
) -> None:
    code, _, error = a2s("learner", "--env", "a2s_case_envs:Control-v0", *options)
    assert code in (1, 2)
    assert "Traceback" not in error
    assert said in error
    assert "a2s_case_envs.py" not in error  # it is not the mistake of the environment
    assert not Path("runs").exists()


@pytest.mark.parametrize(("name", "most"), [("n_step", 64), ("batch_rows", 4096)])
def test_more_than_a_served_replay_gives_is_refused_before_the_run_begins(
    name: str, most: int, tmp_path: Path, a2s: Run
) -> None:
    """Nobody serves one here; it is not even asked for."""
    nobody = ("--replay-from", "first", "--connect", "tcp/127.0.0.1:1")
    code, _, error = a2s("learner", *nobody, "--set", f"{name}={most + 1}")
    assert f"{name}: found {most + 1}, expected at most {most} from a replay over" in error
    assert (code, list(tmp_path.iterdir())) == (2, [])


def test_what_the_parser_refuses_is_exit_code_2(a2s: Run) -> None:
    code, _, error = a2s("learn")
    assert code == 2
    assert "Traceback" not in error


def test_every_option_that_counts_takes_1e0() -> None:
    """And refuses half of one: none was forgotten."""
    commands = get_command(cli.app).commands  # type: ignore[attr-defined]
    commands |= commands.pop("replay").commands
    counts = [
        (command, parameter)
        for command in commands.values()
        for parameter in command.params
        if parameter.type_descriptor.annotation is int
    ]
    assert len(counts) > 20
    for command, parameter in counts:
        context = typer.Context(command)
        assert parameter.process_value(context, "1e0") == 1
        with pytest.raises(UsageError, match=r"found '0.5', expected a whole number such as"):
            parameter.process_value(context, "0.5")


def test_help_says_the_ranges_of_whole_numbers() -> None:
    said = CliRunner().invoke(cli.app, ["replay", "sample", "--help"], env={"COLUMNS": "200"})
    assert "1..4096" in said.output
    assert "[default: 256]" in said.output


@pytest.mark.parametrize("command", ["train", "learner"])
def test_the_options_of_the_environment_are_a_group_of_their_own(command: str) -> None:
    text = CliRunner().invoke(cli.app, [command, "--help"], env={"COLUMNS": "120"}).output
    (group,) = (part for part in text.split("╭─") if part.startswith(" The environment"))
    assert re.findall(r"^│ (--[a-z-]+)", group, re.MULTILINE) == [
        "--env-kwargs", "--wrapper", "--action-repeat", "--frame-stack", "--max-episode-steps",
        "--env-timeout", "--info-metric",
    ]  # fmt: skip


@pytest.mark.slow
def test_every_command_that_needs_no_torch_does_without_it() -> None:
    """`a2s actor` and `a2s evaluate` must work where only the actor is installed."""
    code = (
        "import sys\n"
        "sys.modules['torch'] = sys.modules['onnx'] = sys.modules['matplotlib'] = None\n"
        "import a2s.cli, a2s.commands.actor, a2s.commands.evaluate, a2s.actors.worker\n"
        "print(sorted(m for m in ('torch', 'onnx') if sys.modules[m]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_help_comes_without_heavy_imports() -> None:
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "a2s.cli", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert not imported & {"torch", "onnxruntime", "mujoco", "gymnasium", "matplotlib"}


def test_no_help_has_words_in_brackets_which_would_vanish_as_markup() -> None:
    commands = get_command(cli.app).commands  # type: ignore[attr-defined]
    parameters = [parameter for command in commands.values() for parameter in command.params]
    assert len(parameters) > 50
    assert not [p.name for p in parameters if "[" in (getattr(p, "help", None) or "")]


def test_what_may_not_be_read_is_one_line(tmp_path: Path) -> None:
    """A replay of somebody else; root is asked to leave its powers behind."""
    replay = tmp_path / "run" / "replay"
    replay.mkdir(parents=True, mode=0)
    powerless = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"] if os.geteuid() == 0 else []
    command = [*powerless, sys.executable, "-m", "a2s.cli", "replay", "info", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = (
        f"a2s: {replay}/replay.json: Permission denied; run as a user with read and write access\n"
    )
    assert (done.returncode, done.stderr) == (1, said)


@pytest.mark.parametrize("program", [["a2s"], [sys.executable, "-m", "a2s"]], ids=["a2s", "python"])
def test_the_program_tells_its_version(program: list[str]) -> None:
    """`a2s` is beside its Python."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [*program, "--version"], capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{__version__}\n", "")
