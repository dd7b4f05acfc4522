"""Bad usage: one line that says what and what to do, exit code 2, and no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from a2s import cli
from a2s.protocol.errors import UsageError


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _usage(*arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command line, expect exit code 2, and give what it says on standard error."""
    argv, sys.argv = sys.argv, ["a2s", *arguments]
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        sys.argv = argv
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["learner", "--env", "NoSuchThing-v5"], "NoSuchThing"),
        (["learner", "--env", "CartPole-v1"], "--env InvertedPendulum-v5 is like it"),
        (["learner", "--preset", "modem"], "did you mean 'modern'?"),
        (["learner", "--algo", "a3c"], "did you mean 'a2c'?"),
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
        (["learner", "--set", "gamma=1.5"], "gamma: found 1.5"),
        (["learner", "--set", "recovery_bias=nan"], "recovery_bias: found nan"),
        (["learner", "--set", "gamma"], "found 'gamma', expected KEY=VALUE"),
        (["learner", "--seed", "x"], "--seed or A2S_SEED: found 'x', expected a whole number"),
        (["learner", "--seed", "-1"], "--seed or A2S_SEED: found -1, expected 0 to 92233720368547"),
        (["learner", "--total-steps", "0e3"], "A2S_TOTAL_STEPS: found 0e3, expected at least 1"),
        (["learner", "--total-steps", "1e-3"], "found '1e-3', expected a whole number such as"),
        (["learner", "--total-steps", "1.5e0"], "found '1.5e0', expected a whole number such as"),
        (["learner", "--total-steps", "inf"], "found 'inf', expected a whole number such as 1000"),
        (["learner", "--total-steps", "nan"], "found 'nan', expected a whole number such as 1000"),
        (["learner", "--total-steps", "1e999999999"], "found '1e999999999', expected a whole num"),
        (["learner", "--seed", str(10**22)], f"found {10**22}, expected 0 to {2**63 - 1}"),
        (["learner", "--metrics-port", "-2"], "found -2, expected -1 to 65535"),
        (["actor", "--n", "0"], "--n or A2S_N: found 0, expected at least 1"),
        (["bench", "wire", "--rounds", "0"], "--rounds: found 0, expected at least 1"),
        (["learner", "--suggestions", "0"], "suggestions: found 0"),
        (["learner", "--run", "a/b"], "run name: found 'a/b'"),
        (["learner", "--listen", "7447"], "expected PROTOCOL/HOST:PORT"),
        (["learner", "--device", "gpu"], "device: found 'gpu' (did you mean 'cpu'?)"),
        (["learner", "--device", "cuda"], "expected cpu with variant on-policy"),
        (["learner", "--variant", "off-policy", "--algo", "a2c"], "algo: found a2c, expected a2s"),
        (["learner", "--variant", "off-policy", "--recovery"], "only on-policy learning has"),
        (["train", "--variant", "off-policy", "--no-recovery"], "only on-policy learning has"),
        (["learner", "--config", "missing.toml"], "missing.toml: No such file"),
        (["learner", "--resume"], "found no run 'default'"),
        (["learner", "--resume", "--run-dir", "nowhere"], "nowhere holds no config.toml"),
        (["actor", "--connect", "learner:7447"], "expected PROTOCOL/HOST:PORT"),
        (["actor", "--run", "*"], "run name: found '*'"),
        (["evaluate", "nowhere"], "No such file"),
        (["evaluate", ".", "--mode", "men"], "did you mean 'mean'?"),
        (["evaluate", ".", "--weights", "newest"], "--weights: found 'newest'"),
        (["plot", "nowhere"], "nowhere: is not a run directory"),
    ],
)
def test_a_mistake_gets_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = _usage(*arguments, capsys=capsys)
    assert said in error
    assert error.startswith("a2s: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize(("name", "most"), [("n_step", 64), ("batch_rows", 4096)])
def test_more_than_a_served_replay_gives_is_refused_before_the_run_begins(
    name: str, most: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody serves one here; it is not even asked for."""
    nobody = ("--replay-from", "first", "--connect", "tcp/127.0.0.1:1")
    error = _usage("learner", *nobody, "--set", f"{name}={most + 1}", capsys=capsys)
    assert f"{name}: found {most + 1}, expected at most {most} from a replay over" in error
    assert list(tmp_path.iterdir()) == []


def test_what_the_parser_refuses_is_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert "Traceback" not in _usage("learn", capsys=capsys)


def _print_config(*arguments: str) -> str:
    result = CliRunner().invoke(cli.app, ["learner", "--print-config", *arguments])
    assert result.exit_code == 0, result.output
    return str(result.output)


def test_an_option_beats_a_variable_beats_a_file_beats_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.toml"
    assert "\nseed = 0\n" in _print_config()
    file.write_text("[run]\nseed = 7\n[hyper]\ngamma = 0.5\n")
    said = _print_config("--config", str(file))
    assert "\nseed = 7\n" in said
    assert "\ngamma = 0.5  # set by you" in said
    monkeypatch.setenv("A2S_SEED", "8")
    assert "\nseed = 8\n" in _print_config("--config", str(file))
    assert "\nseed = 9\n" in _print_config("--config", str(file), "--seed", "9")


@pytest.mark.parametrize("million", ["1e6", "1E+6", "1000000.0", "1_000_000", "10.0e5"])
def test_a_million_may_be_written_in_any_way(
    million: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = _print_config("--total-steps", million, "--set", f"batch_steps={million}")
    assert "\ntotal_steps = 1000000\n" in said
    assert "\nbatch_steps = 1000000  # set by you" in said
    file = tmp_path / "mine.toml"
    file.write_text(f"[run]\ntotal_steps = {million}\n[hyper]\nbatch_steps = {million}\n")
    assert _print_config("--config", str(file)) == said
    monkeypatch.setenv("A2S_TOTAL_STEPS", million)
    assert "\ntotal_steps = 1000000\n" in _print_config()


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


def test_suggestions_are_those_among_which_q_picks_in_either_variant() -> None:
    assert "\nsuggestions = 3  # set by you" in _print_config("--suggestions", "3")
    off = _print_config("--suggestions", "3", "--variant", "off-policy")
    assert "\nact_suggestions = 3  # set by you" in off


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        ([], "invariant"),
        (["--no-recovery"], "off"),
        (["--algo", "a2c"], "off"),
        (["--algo", "a2c", "--recovery"], "invariant"),
        (["--algo", "a2c", "--preset", "authors", "--recovery"], "authors"),
    ],
)
def test_recovery_is_the_rule_of_the_preset_or_off(arguments: list[str], rule: str) -> None:
    assert f'\nrecovery = "{rule}"' in _print_config(*arguments)


def test_a_printed_configuration_loads_again(tmp_path: Path) -> None:
    file = tmp_path / "printed.toml"
    file.write_text(_print_config("--preset", "authors", "--set", "suggestions=3"))
    again = _print_config("--config", str(file))
    assert 'preset = "authors"' in again
    assert "\nsuggestions = 3  # set by you" in again
    assert again == file.read_text()


@pytest.mark.parametrize("other", [("--variant", "on-policy"), ("--preset", "sac")], ids=" ".join)
def test_values_of_a_file_are_not_those_of_another_variant_or_preset(
    other: tuple[str, str], tmp_path: Path
) -> None:
    file = tmp_path / "printed.toml"
    file.write_text(_print_config("--variant", "off-policy", "--set", "tau=0.5"))
    assert "\ntau = 0.5  # set by you" in _print_config("--config", str(file))
    said = _print_config("--config", str(file), *other)
    assert f'\n{other[0].lstrip("-")} = "{other[1]}"' in said
    assert "set by you" not in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[run]\nsed = 1\n", "did you mean 'seed'?"),
        ("[runs]\n", "did you mean 'run'?"),
        ("run = 3\n", "bad.toml: run: found 3, expected a table [run]"),
        ("hyper = [1]\n", "bad.toml: hyper: found [1], expected a table [hyper]"),
        ("[[run]]\nseed = 1\n", "bad.toml: run: found [{'seed': 1}], expected a table [run]"),
        (
            "[hyper]\nlearn_rate = 1\n",
            "bad.toml: unknown hyperparameter 'learn_rate' in [hyper] (did you mean 'learning_r",
        ),
        (
            "[run]\nvariant = 'off-policy'\n[hyper]\ntaus = 1\n",
            "bad.toml: unknown hyperparameter 'taus' in [hyper] (did you mean 'tau'?)",
        ),
        ("[run]\nn_envs = 4\n", "bad.toml: unknown option 'n_envs' in [run] (here it is 'envs')"),
        ("[hyper]\nn_steps = 4\n", "'n_steps' in [hyper] (here it is 'batch_steps')"),
        (
            "[run]\nvariant = 'off-policy'\n[hyper]\nn_steps = 4\n",
            "'n_steps' in [hyper] (here it is 'n_step')",
        ),
        ("[run]\nseed = 'x'\n", "seed: found 'x', expected a whole number"),
        ("[run]\nseed = true\n", "seed: found True, expected a whole number"),
        ("[run]\nseed = 0.5\n", "seed: found 0.5, expected a whole number"),
        ("[run]\nseed = inf\n", "seed: found inf, expected a whole number"),
        ("[run]\nenvs = 1e4\n", "envs: found 10000, expected 1 to 4096"),
        ("[run]\nenv = 3.0\n", "env: found 3.0, expected text"),
        ("[hyper]\nbatch_steps = 1.5\n", "batch_steps: found 1.5, expected a whole number"),
        (f"[run]\nseed = {2**63}\n", f"seed: found {2**63}, expected 0 to {2**63 - 1}"),
        ("[run\n", "not TOML"),
        ("[run]\nvariant = 'of-policy'\n[hyper]\ntau = 1\n", "variant: found 'of-policy'"),
        ("[run]\nvariant = [1]\n", "variant: found [1]"),
        ("[run]\nclock = 'sync'\n", "clock: found 'sync'"),
    ],
)
def test_a_file_with_a_mistake_gets_one_line(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.toml").write_text(text)
    assert said in _usage("learner", "--config", "bad.toml", capsys=capsys)


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
    said = f"a2s: {replay}/replay.json: Permission denied; run as who may read and write it\n"
    assert (done.returncode, done.stderr) == (1, said)
