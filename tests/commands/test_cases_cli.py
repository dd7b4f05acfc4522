"""Small things that people type: numbers as they write them, names of other libraries."""

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from a2s import cli


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _config(*arguments: str) -> str:
    result = CliRunner().invoke(cli.app, ["learner", "--print-config", *arguments])
    assert result.exit_code == 0, result.output
    return str(result.output)


def _refused(*arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    argv, sys.argv = sys.argv, ["a2s", *arguments]
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        sys.argv = argv
    assert ended.value.code in (1, 2)
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("written", "meant"),
    [("1e6", 1_000_000), ("1E6", 1_000_000), ("2.5e3", 2500), ("1_000", 1000), ("3000.0", 3000)],
)
def test_a_whole_number_may_be_written_as_people_write_it(written: str, meant: int) -> None:
    assert f"\ntotal_steps = {meant}\n" in _config("--total-steps", written)
    off = ("--variant", "off-policy", "--set", f"replay_rows={written}")
    assert f"\nreplay_rows = {meant}  #" in _config(*off)


@pytest.mark.parametrize("written", ["1.5", "1e-3", "nan", "inf", "1e6x", "0", "-1e3"])
def test_what_is_no_whole_number_is_refused(
    written: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = _refused("learner", "--total-steps", written, "--print-config", capsys=capsys)
    assert "--total-steps" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [("buffer_size", "replay_rows"), ("replay_size", "replay_rows"), ("batch_size", "batch_rows")],
)
def test_the_name_that_another_library_has_is_answered_with_ours(
    theirs: str, ours: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("learner", "--variant", "off-policy", "--set", f"{theirs}=5")
    assert f"'{ours}'" in _refused(*words, capsys=capsys)


def test_the_options_of_the_environment_are_a_group_of_their_own() -> None:
    """Each with its line, in the help of all who take them."""
    for command in ("train", "learner"):
        text = CliRunner().invoke(cli.app, [command, "--help"], env={"COLUMNS": "120"}).output
        groups = [
            part for part in text.split("╭─") if "environment" in part.splitlines()[0].lower()
        ]
        assert len(groups) == 1, command
        for option in (
            "--env-kwargs", "--wrapper", "--action-repeat", "--frame-stack",
            "--max-episode-steps", "--env-timeout", "--info-metric",
        ):  # fmt: skip
            assert option in groups[0], (command, option)


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
def test_an_option_of_the_environment_that_cannot_be_is_refused_with_its_name(
    options: tuple[str, str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = _refused("learner", "--env", "a2s_case_envs:Control-v0", *options, capsys=capsys)
    assert "Traceback" not in error
    assert said in error
    assert "a2s_case_envs.py" not in error  # the control has nothing to do with it
    assert not Path("runs").exists()
