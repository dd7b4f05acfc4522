"""Freed memory is kept, and batches have to fit into it."""

import subprocess
import sys

import numpy as np
import pytest

from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.run.config import on_policy
from a2s.learner.run.memory import require_room
from a2s.protocol.errors import UsageError
from a2s.protocol.fields import Spaces

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


@pytest.mark.parametrize("name", ["batch_steps", "window_steps"])
def test_a_batch_that_the_memory_cannot_hold_is_refused(name: str) -> None:
    spaces = Spaces(obs_size=4, action_low=-np.ones(2, np.float32), action_high=np.ones(2, "<f4"))
    require_room(OnPolicyConfig(), spaces)
    too_large = on_policy("modern", "a2s", {name: 10**12})
    with pytest.raises(UsageError, match=f"{name}: found 1000000000000, which are 37,253 GiB"):
        require_room(too_large, spaces)
