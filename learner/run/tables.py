"""The page docs/hyperparameters.md, made of the configurations: `make docs` writes it."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from a2s.learner.off_policy.config import PRESETS as OFF_POLICY
from a2s.learner.on_policy.presets import PRESETS as ON_POLICY

_HEAD = """# Hyperparameters

Made from the code by `make docs`; do not edit. `a2s learner --preset NAME --print-config` shows
the values of a run with their sources, `--set NAME=VALUE` changes any. The preset `modern` is the
default. `=` means: the same as in the first column.
"""


def page() -> str:
    """Write the whole page."""
    modern = {"modern": ON_POLICY["modern"]}
    literal = {name: ON_POLICY[name] for name in ("authors", "paper")}
    return "\n".join(
        [
            _HEAD,
            *_table("On-policy", modern),
            "",
            *_table("On-policy, the paper to the letter", literal),
            "",
            *_table("Off-policy", OFF_POLICY),
            "",
        ]
    )


def _table(title: str, presets: Mapping[str, Any]) -> list[str]:
    first, *others = (asdict(preset.config) for preset in presets.values())
    about = next(iter(presets.values())).config.about()
    lines = [
        f"## {title}",
        "",
        f"| hyperparameter | {' | '.join(presets)} | range | meaning | why (first column) |",
        f"|---{'|---' * (len(presets) + 3)}|",
    ]
    for name, setting in about.items():
        cells = [_cell(first[name])]
        cells += ["=" if each[name] == first[name] else _cell(each[name]) for each in others]
        has_range = isinstance(first[name], int | float) and not isinstance(first[name], bool)
        span = f"{setting.low:g} to {setting.high:g}" if has_range else ""
        words = f"{setting.meaning} | {setting.source}".replace("``", "`")
        lines.append(f"| `{name}` | {' | '.join(cells)} | {span} | {words} |")
    return lines


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "-".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    print(page(), end="")  # noqa: T201 - `make docs` sends it to the file
