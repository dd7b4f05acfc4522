"""What tests share: the plug-in environments, graphs, and waiting without sleeping."""

import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import torch

from a2s.learner.export.on_policy import export
from a2s.learner.on_policy.config import OnPolicyConfig
from a2s.learner.on_policy.update import OnPolicy
from a2s.protocol.messages import Notice

PLUGIN = Path(__file__).parent / "plugin"
sys.path.insert(0, str(PLUGIN))
# Actors that tests start may run what their learners name.
os.environ["A2S_ALLOW_ENV"] = " ".join(path.stem for path in PLUGIN.glob("a2s_*.py"))
# Processes that tests start find the plug-in environments too.
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(PLUGIN), *filter(None, [os.environ.get("PYTHONPATH")])]
)

MakeGraph = Callable[..., bytes]
WaitFor = Callable[..., None]
NoRoom = Callable[[], AbstractContextManager[None]]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those that last begin first, so that no worker is alone at the end."""
    items.sort(key=lambda item: not any(map(item.get_closest_marker, ("system", "slow"))))


@pytest.fixture(autouse=True)
def _same_numbers() -> None:
    """What a test draws without a generator of its own is the same every time."""
    torch.manual_seed(0)


@pytest.fixture
def make_graph() -> MakeGraph:
    """Export untrained networks for an environment with these sizes and bounds."""

    def make(
        obs_size: int = 2,
        low: tuple[float, ...] = (-1.0, 0.5),
        high: tuple[float, ...] = (3.0, 0.75),
        metadata: Mapping[str, str] = MappingProxyType({"env": "a2s_test_envs:Count-v0"}),
        **overrides: Any,
    ) -> bytes:
        algorithm = OnPolicy(obs_size, len(low), OnPolicyConfig(**overrides), seed=0)
        algorithm.q_trusted = True
        suggester = algorithm.suggester(torch.tensor(low), torch.tensor(high))
        return export(suggester, 3, metadata)

    return make


@pytest.fixture
def make_notice() -> Callable[..., Notice]:
    """Make a notice with some fields of interest."""

    def make(**fields: int) -> Notice:
        values = {
            "generation": 1, "epoch": 0, "version": 3, "quota_steps": 7, "quota_episodes": 0,
            "num_bytes": 1,
        }  # fmt: skip
        return Notice(sha256="", **{**values, **fields})

    return make


@pytest.fixture
def no_room() -> NoRoom:
    """As long as a block lasts the kernel lets no file grow beyond 100 bytes."""

    @contextmanager
    def limited() -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            signal.signal(signal.SIGXFSZ, ignored)

    return limited


@pytest.fixture
def wait_for() -> WaitFor:
    """Wait until something is true, and fail with its name when it never is."""

    def wait(condition: Callable[[], object], what: str, timeout_s: float = 60.0) -> None:
        deadline_s = time.monotonic() + timeout_s
        pause = threading.Event()
        while not condition():
            assert time.monotonic() < deadline_s, f"waited {timeout_s:.0f} s for {what}"
            pause.wait(0.02)

    return wait


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(0)
