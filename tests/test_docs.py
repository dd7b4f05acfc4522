"""What the pages say of the code is there: ``file.py: name`` in backticks, also of a class."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
_PLACE = re.compile(r"`([\w/]+\.py): ([\w., ]+)`")


def test_places_in_the_code_that_the_pages_name_exist() -> None:
    """Paths are from the root, or from the package of the learner, as in docs/algorithm.md."""
    wrong, seen = [], 0
    for page in sorted((ROOT / "docs").rglob("*.md")):
        for path, names in _PLACE.findall(page.read_text()):
            files = [file for file in (ROOT / path, ROOT / "learner" / path) if file.exists()]
            text = files[0].read_text() if files else ""
            for name in names.split(", "):
                seen += 1
                *_, last = name.split(".")
                is_there = re.search(rf"^\s*(?:def|class) {last}\b|^\s*{last}\b.*[:=]", text, re.M)
                if not is_there:
                    wrong.append(f"{page.relative_to(ROOT)}: {path}: {name}")
    assert wrong == []
    assert seen > 0
