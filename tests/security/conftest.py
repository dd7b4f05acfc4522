"""Real certificates, and a real learner that lets only known peers in."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from learners import learner_of
from secured import Site, free_port

from a2s.commands.certs import make
from a2s.protocol.access import role_of
from a2s.protocol.identity import Security
from a2s.protocol.keys import Keys
from a2s.protocol.zenoh_bus import ZenohBus

PEERS = ("actor", "actor-lab1", "viewer")
PASSWORDS = {name: f"secret of {name}" for name in PEERS}


@pytest.fixture(scope="session")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``a2s certs --actor lab1`` makes."""
    folder = tmp_path_factory.mktemp("certs")
    list(make(folder, [], ["lab1"], [], 90))
    return folder


@pytest.fixture(scope="session", params=["certificates", "passwords"])
def security(
    request: pytest.FixtureRequest, certs: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Security]:
    """What the peer of a name gives; that of the learner for ``learner``."""
    if request.param == "certificates":
        return lambda name: Security(tls=str(certs / name))
    folder = tmp_path_factory.mktemp("passwords")
    lines = {name: f"{name}:{password}\n" for name, password in PASSWORDS.items()}
    for name, text in {**lines, "learner": "".join(lines.values())}.items():
        (folder / name).write_text(text)
    return lambda name: Security(password_file=str(folder / name))


@pytest.fixture(scope="session")
def site(
    security: Callable[[str], Security], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Site]:
    """A learner that waits for two actors, in a thread; its first weights are out."""
    keys, path = Keys("secured"), tmp_path_factory.mktemp("secured") / "run"
    path.mkdir()
    own = security("learner")
    endpoint = own.endpoint(f"tcp/127.0.0.1:{free_port()}")
    stop = threading.Event()
    with ExitStack() as stack:
        bus = stack.enter_context(closing(ZenohBus.listen(endpoint, own.listener(keys, endpoint))))
        bus.answer(keys.replay_info, lambda _: b"of the replay")
        options = {"env": "Test-v0", "n": 2, "envs": 1, "run": "secured", "total_steps": 64}
        settings = {"batch_steps": 32, "first_batch_steps": 32, "critic_epochs": 1}
        learner = learner_of(options, settings, bus, path)
        pool = stack.enter_context(ThreadPoolExecutor(1))
        stack.callback(stop.set)
        pool.submit(learner.run, stop.is_set)

        def peer(name: str) -> ZenohBus:
            identity = security(name).peer(role_of(name))
            return stack.enter_context(closing(ZenohBus.connect(endpoint, lambda: False, identity)))

        made = Site(endpoint, keys, bus, path, peer)
        made.wait_for_weights()
        yield made
