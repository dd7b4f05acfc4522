"""The tutorial, as a reader does it: its commands run in order, in an empty directory."""

import os
import re
import subprocess
import sys
from pathlib import Path

import doc_pages
import pytest
from system_helpers import PATIENCE_S

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(2 * PATIENCE_S)]
PAGE = doc_pages.ROOT / "docs/tutorial.md"


def test_every_command_of_the_tutorial_works(tmp_path: Path, endpoint: str) -> None:
    """And the policy that it trains balances the pole in ONNX Runtime, as the page shows."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    blocks, said = doc_pages.fences(PAGE), ""
    for block in blocks:
        title = re.search(r'title="(.+)"', block.info)
        if title:
            (tmp_path / title[1]).write_text(block.body)
        if block.info != "sh" or block.reason:
            continue
        # The usual port may be another test's; `a2s doctor` expects a learner where it is told.
        has_actors = "a2s actor" in block.body
        where = {"A2S_LISTEN": endpoint, "A2S_CONNECT": endpoint} if has_actors else {}
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block.body],
            cwd=tmp_path,
            env={**os.environ, "PATH": path, **where},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, f"{block.body}{done.stdout}{done.stderr}"
        said = done.stdout
    assert said == blocks[-1].body == "return 1000\n"
    _assert_documented(tmp_path / "runs/default")


def _assert_documented(run: Path) -> None:
    """Every file that a run leaves is on the page of the run directory."""
    table = doc_pages.rows((doc_pages.ROOT / "docs/run-directory.md").read_text())
    names = " ".join(row[0] for row in table)
    known = {name.split("/")[0] for name in re.findall(r"`([^`]+)`", names)}
    assert {file.name for file in run.iterdir()} <= known


def test_every_block_that_is_not_run_says_why() -> None:
    """On the tutorial only the installation; on the other pages those that take long or more."""
    reasons = [
        (page.stem, fence.reason)
        for page in doc_pages.PAGES
        for fence in doc_pages.fences(page)
        if fence.info == "sh" and page.name != "README.md"
    ]
    unexplained = {page for page, reason in reasons if not reason}
    assert unexplained == {"tutorial"}
    assert [reason for page, reason in reasons if page == "tutorial" and reason] == [
        "the tests run in such an installation"
    ]
