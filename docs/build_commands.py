"""The page docs/commands.md, made of the command line: `make docs` writes it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.main import get_command

from a2s import cli

_KINDS = {str: "TEXT", float: "X", Path: "PATH"}
_HEAD = """# Commands

Made from the code by `make docs`; do not edit. `a2s COMMAND --help` says the same.

- Every option of `a2s learner`, `a2s actor` and `a2s train`, also where another command has it, can
  be given by a variable: `--total-steps` by `A2S_TOTAL_STEPS`. The option comes first, then the
  variable, then `--config`, then the default ([configuration](configuration.md)). For an option
  that may be repeated it has the values with spaces between them, none in a value:
  `A2S_SET='gamma=0.99 suggestions=3'`.
- A number of steps may be written as `1e6`.
- `--json` prints JSON as the last line of standard output, and all else elsewhere: an array in
  `a2s bench`, `compare` and `doctor`, an object in the others.
- Exit codes: 0 done, 1 failed, 2 a mistake in the command, 128 and its number after a signal
  (130: Ctrl-C). An error is one line on standard error. Output that cannot be written is a failure,
  too; where only its reader has gone, as of a pipe into `head`, without that line. `a2s learner`,
  `a2s actor` and `a2s train` go on without their output.

## Completion in the shell

`a2s --install-completion` adds completion of commands and options to the present shell: bash, zsh,
fish or PowerShell. It takes effect in the next one, where `a2s` is found: activate the virtual
environment first. `a2s --show-completion` prints it instead.
"""


def page() -> str:
    """Write the whole page."""
    return "\n".join([_HEAD, *(line for each in _commands(cli.app) for line in _section(*each))])


def _commands(app: Any) -> Iterator[tuple[str, Any]]:
    """Every command by its whole name, those of groups after the others."""
    pending = list(get_command(app).commands.items())  # type: ignore[attr-defined]
    for name, command in pending:
        if hasattr(command, "commands"):
            pending += [(f"{name} {inner}", each) for inner, each in command.commands.items()]
        else:
            yield f"a2s {name}", command


def _section(name: str, command: Any) -> Iterator[str]:
    parameters = [each for each in command.params if not getattr(each, "hidden", False)]
    arguments = [each for each in parameters if each.param_type_name == "argument"]
    words = [_written(each) for each in arguments]
    yield f"## {name}"
    yield ""
    yield f"`{' '.join([name, '[OPTIONS]', *words])}`"
    yield ""
    yield command.help.replace("\\[", "[")
    yield ""
    if arguments:
        yield from ["| argument | meaning |", "|---|---|"]
        yield from (f"| `{_written(each)}` | {each.help} |" for each in arguments)
        yield ""
    yield from ["| option | default | meaning |", "|---|---|---|"]
    for option in _options(parameters):
        yield f"| {_names(option)} | {_default(option)} | {_cell(option.help)} |"
    yield ""


def _written(argument: Any) -> str:
    name = (argument.metavar or argument.name.upper()).strip("[]")
    dots = "..." if argument.nargs == -1 else ""
    return f"{name}{dots}" if argument.required else f"[{name}{dots}]"


def _options(parameters: list[Any]) -> list[Any]:
    """The options of a command, in the order of the panels of its help."""
    found = [each for each in parameters if each.param_type_name == "option"]
    panels = [each.rich_help_panel for each in found]
    own = [each for each in found if "--help" not in each.opts]
    return sorted(own, key=lambda each: panels.index(each.rich_help_panel))


def _names(option: Any) -> str:
    names = sorted(option.opts, key=len) + option.secondary_opts
    kind = option.type_descriptor.annotation
    value = "" if option.is_flag else _cell(f" {option.metavar or _KINDS[kind]}")
    return ", ".join(f"`{name}{value}`" for name in names)


def _default(option: Any) -> str:
    if isinstance(option.show_default, str):
        return _cell(option.show_default)
    if option.is_flag or option.default in (None, ()):
        return ""
    return f"`{option.default}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    print(page(), end="")  # noqa: T201 - `make docs` sends it to the file
