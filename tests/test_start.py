"""The program before it has begun, and where its words cannot be written."""

import os
import subprocess
import sys

import pytest

# It is sent when the command line's own library is about to be imported.
SCRIPT = """
import os, signal, sys
class Sends:
    def find_spec(self, name, *_):
        if name == "typer":
            os.kill(os.getpid(), int(sys.argv[1]))
sys.meta_path.insert(0, Sends())
from a2s.start import main
main()
"""


@pytest.mark.parametrize("number", [1, 2, 15])
def test_a_signal_while_it_is_imported_ends_it_without_a_word(number: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(number)], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, b"", b"")


COMMANDS = (("--version",), ("actor", "--help"))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_cannot_be_written_is_one_line_and_a_closed_pipe_none(
    words: tuple[str, ...], unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    reader, writer = os.pipe()
    os.close(reader)
    with open("/dev/full", "w") as full, open(writer, "w") as closed:
        ends = [
            subprocess.run(
                [sys.executable, "-m", "a2s", *words], stdout=out, stderr=subprocess.PIPE,
                text=True, check=False, timeout=60,
            )
            for out in (full, closed)
        ]  # fmt: skip
    said = "standard output: No space left on device; make room there, or send it elsewhere"
    assert [(done.returncode, done.stderr) for done in ends] == [(1, f"a2s: {said}\n"), (1, "")]
