"""The commands on the pages against the command line."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import doc_pages
import pytest
from typer.main import get_command

from a2s import cli

ROOT = doc_pages.ROOT
FOREIGN = {"--scale", "--build-arg", "--standalone", "--nproc-per-node"}  # of docker, torchrun
COMMANDS = [(page, words) for page in doc_pages.PAGES for words in doc_pages.commands(page)]


def _command(words: list[str]) -> tuple[Any, list[str]]:
    """The command that is meant, and its arguments."""
    command: Any = get_command(cli.app)
    while hasattr(command, "commands"):
        name, *words = words
        command = command.commands[name]
    return command, words


def _options(command: Any) -> set[str]:
    if hasattr(command, "commands"):
        inner = [_options(each) for each in command.commands.values()]
        return set().union(*inner, *(each.opts for each in command.params))
    return {name for each in command.params for name in (*each.opts, *each.secondary_opts)}


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=[f"{page.stem}: {' '.join(words)}" for page, words in COMMANDS]
)
def test_every_command_in_a_block_can_be_parsed(page: Path, words: list[str]) -> None:
    """Its options exist, and take the values that they are given."""
    command, arguments = _command(words)
    command.make_context(command.name, arguments)


def test_commands_are_found_on_the_pages() -> None:
    """Also behind a prompt, in a list and in a loop, with a comment and over two lines."""
    found = {page.stem: list(doc_pages.commands(page)) for page in reversed(doc_pages.PAGES)}
    assert len(found["README"]) > 15
    assert ["learner", "--env", "Walker2d-v5", "--n", "16"] in (
        [words[:5] for words in found["machines"]]
    )
    assert found["variant"][0][:2] == ["train", "--env"]
    assert found["tune"][-1][-2:] == ["--set", "tau=0.005"]


def test_every_option_that_a_page_names_exists() -> None:
    known = _options(get_command(cli.app)) | FOREIGN | {"--help"}
    wrong, seen = [], 0
    for page in doc_pages.PAGES:
        for code in re.findall(r"`([^`\n]+)`", page.read_text()):
            for option in re.findall(r"(?:^|(?<=[ \[]))--[a-z][a-z-]*", code):
                seen += 1
                if option not in known:
                    wrong.append(f"{page.name}: {code}")
    assert wrong == []
    assert seen > 100


def test_the_page_of_commands_is_what_the_code_gives() -> None:
    """`make docs` writes it."""
    program = [sys.executable, str(ROOT / "docs/build_commands.py")]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    assert (ROOT / "docs/commands.md").read_text() == done.stdout


@pytest.mark.slow
def test_bash_completes_commands_and_options(tmp_path: Path) -> None:
    """With what `a2s --install-completion` installs."""
    script = """
        a2s --install-completion > /dev/null
        . ~/.bashrc
        for typed in "a2s le" "a2s train --total" "a2s replay s"; do
          COMP_WORDS=($typed)
          COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
          _a2s_completion a2s
          echo "${COMPREPLY[*]}"
        done
    """
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**os.environ, "HOME": str(tmp_path), "PATH": path}
    done = subprocess.run(
        ["bash", "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["learner", "--total-steps", "sample"]
