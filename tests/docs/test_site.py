"""The documentation as a site."""

import os
import re
import subprocess
import sys
from pathlib import Path

import doc_pages
import pytest

pytestmark = pytest.mark.slow
_LOADED = re.compile(r"""<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=["']?(?:https?:)?//""")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it as `make site` does: a broken link or a page that no menu has is an error.

    With `--quiet` it would not be: warnings that are not written are not counted.
    """
    place = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(place)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=doc_pages.ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return place


def test_it_has_the_pages_of_the_repository(site: Path) -> None:
    """Also those outside docs/, and every decision in the menu."""
    for page in ("index", "tutorial", "how-to/own-actor", "CHANGELOG", "benchmarks/index"):
        assert (site / f"{page}.html").exists()
    menu = (site / "index.html").read_text()
    decisions = list((doc_pages.ROOT / "docs/adr").glob("*.md"))
    assert len(decisions) > 20
    assert all(f'href="adr/{page.stem}.html"' in menu for page in decisions)
    assert (site / "examples/robot_actor.py").exists()
    assert not list(site.glob("*.py"))


def test_it_loads_nothing_from_elsewhere(site: Path) -> None:
    """So it is whole without a network."""
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    assert [page.name for page in pages if _LOADED.search(page.read_text())] == []
    styles = [style.read_text() for style in site.rglob("*.css")]
    assert not any(re.search(r"url\(['\"]?(?:https?:)?//", style) for style in styles)
