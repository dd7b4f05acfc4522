"""Hooks of mkdocs: pages of the repository outside docs/ belong to the site, and links reach them.

A link to a file that is no page, such as a program, becomes the path of that file as text.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

_ROOT = Path(__file__).parents[1].resolve()
_DOCS = _ROOT / "docs"
_OUTSIDE = ("CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/**/*.md", "benchmarks/**/*.png")
_LINK = re.compile(r"(?P<text>\[[^\]\n]*\])\((?P<place>[^)#:\s]+)(?P<anchor>#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> None:
    """Every decision is in the navigation, in the order of its number."""
    pages = [f"adr/{page.name}" for page in sorted((_DOCS / "adr").glob("*.md"))]
    config.nav = [*(config.nav or []), {"Decisions": pages}]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages outside docs/ under their paths in the repository."""
    for path in (path for pattern in _OUTSIDE for path in sorted(_ROOT.glob(pattern))):
        name = str(path.relative_to(_ROOT))
        files.append(File.generated(config, name, abs_src_path=str(path)))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links to what lies elsewhere in the site than in the repository.

    A link to what does not exist stays as it is, and mkdocs refuses it.
    """
    source = Path(str(page.file.abs_src_path)).resolve()

    def rewritten(link: re.Match[str]) -> str:
        place = (source.parent / link["place"]).resolve()
        if not place.exists() or not place.is_relative_to(_ROOT):
            return link[0]
        name = str(place.relative_to(_DOCS if place.is_relative_to(_DOCS) else _ROOT))
        if files.get_file_from_path(name) is None:
            return f"{link['text'][1:-1]} (`{place.relative_to(_ROOT)}`)"
        up = "../" * page.file.src_uri.count("/")
        return f"{link['text']}({up}{name}{link['anchor'] or ''})"

    return _LINK.sub(rewritten, markdown)
