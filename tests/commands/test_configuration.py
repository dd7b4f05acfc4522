"""Where the configuration of a run comes from: options, variables, files and defaults."""

import shlex
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from a2s import cli
from a2s.commands.run_cli import again_by
from a2s.learner.run.directory import claimed
from a2s.protocol.errors import UsageError


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


@pytest.mark.parametrize("million", ["1e6", "1E6", "1E+6", "1000000.0", "1_000_000", "10.0e5"])
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


def test_suggestions_are_those_among_which_q_picks_in_either_variant() -> None:
    assert "\nsuggestions = 3  # set by you" in _print_config("--suggestions", "3")
    off = _print_config("--suggestions", "3", "--variant", "off-policy")
    assert "\nact_suggestions = 3  # set by you" in off


@pytest.mark.parametrize("variant", ["on-policy", "off-policy"])
def test_a_shorthand_is_an_option_or_a_variable_as_it_was_given(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "suggestions" if variant == "on-policy" else "act_suggestions"
    options = ["--variant", variant, "--set", f"{name}=3"]
    monkeypatch.setenv("A2S_SUGGESTIONS", "4")
    assert f"\n{name} = 4  # set by you" in _print_config("--variant", variant)
    assert f"\n{name} = 3  # set by you" in _print_config(*options)
    assert f"\n{name} = 5  # set by you" in _print_config(*options, "--suggestions", "5")
    monkeypatch.setenv("A2S_SET", f"{name}=6")
    assert f"\n{name} = 5  # set by you" in _print_config("--variant", variant, "--suggestions=5")


def test_recovery_given_as_an_option_beats_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("A2S_SET", "recovery=authors")
    assert '\nrecovery = "authors"' in _print_config()
    assert '\nrecovery = "off"' in _print_config("--no-recovery")
    monkeypatch.setenv("A2S_RECOVERY", "1")
    assert '\nrecovery = "off"' in _print_config("--set", "recovery=off")


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


def test_files_that_a_file_names_are_found_from_another_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of options are, too: a run keeps their absolute names."""
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(
        '[run]\nenv = "./sim.py:Walk"\nwrappers = ["./sim.py:Slow={\\"by\\": 2}"]\n'
        'variant = "off-policy"\nprior = "data"\ninit_from = "before"\n'
    )
    said = _print_config("--config", "mine.toml")
    assert f'\nenv = "{tmp_path}/sim.py:Walk"\n' in said
    assert f'"{tmp_path}/sim.py:Slow={{' in said
    assert f'\nprior = "{tmp_path}/data"\n' in said
    assert f'\ninit_from = "{tmp_path}/before"\n' in said


def test_a_preset_of_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('[run]\npreset = ["modern"]\n')
    options = ["learner", "--print-config", "--config", str(file), "--recovery"]
    with pytest.raises(UsageError, match="preset"):
        CliRunner().invoke(cli.app, options, catch_exceptions=False)


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
        ("[run]\ngamma = 0.9\n", "unknown option 'gamma' in [run] (it belongs in [hyper])"),
        ("[run]\nshort_steps = 9\n", "'short_steps' in [run] (it belongs in [hyper])"),
        (
            "[hyper]\ncheckpoint_every_updates = 9\n",
            "'checkpoint_every_updates' in [hyper] (only in [run] of --config)",
        ),
        ("[hyper]\nn_steps = 4\n", "'n_steps' in [hyper] (here it is 'batch_steps')"),
        (
            "[run]\nvariant = 'off-policy'\n[hyper]\nn_steps = 4\n",
            "'n_steps' in [hyper] (here it is 'n_step')",
        ),
        ("[run]\nseed = 'x'\n", "seed: found 'x', expected a whole number"),
        ("[run]\nseed = true\n", "seed: found True, expected a whole number"),
        ("[run]\nseed = 0.5\n", "seed: found 0.5, expected a whole number"),
        ("[run]\nseed = inf\n", "seed: found inf, expected a whole number"),
        ("[run]\nenvs = 1e4\n", "envs: found 10000, expected a whole number from 1 to 4096"),
        ("[run]\nenv = 3.0\n", "env: found 3.0, expected text"),
        ("[hyper]\nbatch_steps = 1.5\n", "batch_steps: found 1.5, expected a whole number"),
        (f"[run]\nseed = {2**63}\n", f"expected a whole number from 0 to {2**63 - 1}"),
        ("[run\n", "not TOML"),
        ("[run]\nvariant = 'of-policy'\n[hyper]\ntau = 1\n", "variant: found 'of-policy'"),
        ("[run]\nvariant = [1]\n", "variant: found [1]"),
        ("[run]\nclock = 'sync'\n", "clock: found 'sync'"),
    ],
)
def test_a_file_with_a_mistake_gets_one_line(
    text: str, said: str, tmp_path: Path, a2s: Callable[..., tuple[int, str, str]]
) -> None:
    (tmp_path / "bad.toml").write_text(text)
    code, _, error = a2s("learner", "--config", "bad.toml")
    assert (code, error.count("\n")) == (2, 1)
    assert said in error


@pytest.mark.parametrize(
    ("command", "typed"),
    [
        ("learner", ["--listen", "tcp/0.0.0.0:7447", "--metrics-port", "0", "--seed", "3"]),
        ("learner", ["--listen", "tcp/0.0.0.0:7447", "--tls", "my certs", "--insecure"]),
        ("train", ["--password-file", "users"]),
        ("learner", ["--replay-from", "runs/an other", "--connect", "tcp/far:7447"]),
        ("train", ["--run", "mine", "--weights", "best", "--episodes", "3", "--json"]),
    ],
)
def test_the_command_that_goes_on_with_a_run_says_again_what_its_file_does_not(
    tmp_path: Path, command: str, typed: list[str]
) -> None:
    """As it is pasted into a shell."""
    called = get_command(cli.app).commands[command]  # type: ignore[attr-defined]
    place = tmp_path / "a run"
    words = shlex.split(again_by(called.make_context(command, typed.copy()), place))
    assert words[:2] == ["a2s", command]
    context, first = (called.make_context(command, each) for each in (words[2:], typed.copy()))
    changed = {n for n, v in context.params.items() if v != first.params[n]}
    assert changed <= {"resume", "run_dir", "run", "seed", "json_"}
    assert (context.params["resume"], context.params["run_dir"]) == (True, place)


A2S = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize(
    ("summary", "is_at_work", "said"),
    [
        ("", False, "runs/default-2 has not ended; --resume goes on with it"),
        ('{"finished": false}', False, "runs/default-2 has not ended; --resume goes on with it"),
        ('{"finished": true}', False, ""),
        ("", True, ""),
    ],
)
def test_a_run_that_has_not_ended_is_told_to_who_begins_another(
    a2s: A2S, tmp_path: Path, summary: str, is_at_work: bool, said: str
) -> None:
    """The newest one; not while a learner is at work there."""
    for name in ("default", "default-2"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "config.toml").touch()
    newest = tmp_path / "runs" / "default-2"
    if summary:
        (newest / "summary.json").write_text(summary)
    # It ends once its configuration is made.
    words = ("learner", "--env", "E", "--replay-from", "replay", "--prior", "other")
    with claimed(newest) if is_at_work else nullcontext():
        _, _, err = a2s(*words)
    assert err.splitlines()[:-1] == ([said] if said else [])


def test_what_is_learned_again_needs_a_directory_of_its_own(a2s: A2S, tmp_path: Path) -> None:
    (tmp_path / "run-again").mkdir()
    (tmp_path / "run-again" / "config.toml").touch()
    code, _, err = a2s("learner", "--replay-journal", "run")
    said = "run-again is not empty; delete it, or name another with --run-dir"
    assert (code, err) == (2, f"a2s: --replay-journal: {said}\n")


def test_what_is_learned_again_is_beside_a_run_that_is_named_by_dots(
    a2s: A2S, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("run/inner", "run-again/inner"):
        (tmp_path / name).mkdir(parents=True)
    for place, dots in (("run", "."), ("run/inner", "..")):
        monkeypatch.chdir(tmp_path / place)
        code, _, err = a2s("learner", "--replay-journal", dots)
        assert code == 2
        assert f"{tmp_path}/run-again is not empty" in err
