"""The wheel and the tree hold the same: a folder that is added must be added to both."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (built,) = out.iterdir()
    return built


def test_the_wheel_has_every_module_and_nothing_else(wheel: Path) -> None:
    packages = {"actors": "a2s/actors", "learner": "a2s/learner", "protocol": "a2s/protocol"}
    expected = {
        f"{inside}/{file.relative_to(ROOT / folder)}"
        for folder, inside in packages.items()
        for file in (ROOT / folder).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    own = [ROOT / "src/a2s" / name for name in ("__init__.py", "cli.py", "start.py", "py.typed")]
    own += (ROOT / "src/a2s/commands").glob("*.py")
    expected |= {str(file.relative_to(ROOT / "src")) for file in own}
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert found == expected


def test_an_actor_needs_no_torch(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        text = archive.read(name).decode()
    needed = [line.split(": ", 1)[1] for line in text.splitlines() if "Requires-Dist" in line]
    always = [line for line in needed if "extra ==" not in line]
    assert len(always) >= 8
    assert not [line for line in always if line.startswith(("torch", "onnx>", "matplotlib"))]
    assert any(line.startswith("torch") and "learner" in line for line in needed)
