"""Freed memory is kept."""

import subprocess
import sys

SCRIPT = """
import resource, sys
import numpy as np
from a2s.learner.run.memory import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def work():
    return [np.ones(200_000, np.float32) for _ in range(20)]
for _ in range(5):
    work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(mode: str) -> int:
    """Page faults of making and freeing 400 arrays in a process of its own."""
    command = [sys.executable, "-c", SCRIPT, mode]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=50)
    return int(done.stdout)


def test_arrays_come_back_without_page_faults() -> None:
    """16 MB made and freed 20 times are 80,000 pages where they go back to the system."""
    assert faults("keep") < 500 < 5_000 < faults("leave")
