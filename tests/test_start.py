"""The program before it has begun."""

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
