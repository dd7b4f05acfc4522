"""The pages of the documentation, and the commands on them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = tuple(
    page for where in (".", "docs", "docs/how-to") for page in sorted((ROOT / where).glob("*.md"))
)
_SHELL = ("", "sh", "bash", "console")
_FENCE = re.compile(
    r"^(?P<indent> *)(?:<!-- not run: (?P<reason>.+) -->\n(?P=indent))?"
    r"```(?P<info>.*)\n(?P<body>(?:.*\n)*?)(?P=indent)```$",
    re.MULTILINE,
)


class Fence(NamedTuple):
    """A block of code on a page.

    Attributes:
        info: What follows the opening backticks.
        body: The code, without the indentation of the block.
        reason: Why it is not run, as the comment before the block says; else empty.
    """

    info: str
    body: str
    reason: str


def fences(page: Path) -> list[Fence]:
    """Every block of code on a page."""
    found = []
    for each in _FENCE.finditer(page.read_text()):
        lines = each["body"].splitlines(keepends=True)
        body = "".join(line[len(each["indent"]) :] if line.strip() else line for line in lines)
        found.append(Fence(each["info"], body, each["reason"] or ""))
    return found


def commands(page: Path) -> Iterator[list[str]]:
    """The words of every `a2s` command in the blocks of a page, without ``a2s``."""
    for fence in fences(page):
        if fence.info in _SHELL:
            for line in fence.body.replace("\\\n", "").splitlines():
                words = line.strip().removeprefix("$ ")
                if words.startswith("a2s "):
                    filled = re.sub(r"\$\w+", "0", words)  # of a loop
                    yield [w for w in shlex.split(filled, comments=True)[1:] if w != "&"]


def rows(text: str) -> list[list[str]]:
    """The cells of every row of the tables in a text, the headings and rules left out."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    rules = {i for i, row in enumerate(cells) if all(set(cell) <= {"-"} for cell in row)}
    return [row for i, row in enumerate(cells) if i not in rules and i + 1 not in rules]
