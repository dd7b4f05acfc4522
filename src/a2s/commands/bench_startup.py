"""Starts: seconds until a command is of use, and the memory that its processes then have."""

import hashlib
import os
import socket
import subprocess
import tempfile
import threading
from contextlib import ExitStack, closing
from pathlib import Path
from time import monotonic, perf_counter, sleep

import torch

from a2s.actors.environments.environment import Environment
from a2s.commands.bench import Contender, Contest
from a2s.commands.bench_actor import graph
from a2s.commands.process import free_endpoint
from a2s.commands.train import PROGRAM
from a2s.protocol.codec import decode, encode
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import A2SError
from a2s.protocol.keys import Keys
from a2s.protocol.messages import Ack, Hello, Notice, Weights, Welcome
from a2s.protocol.zenoh_bus import ZenohBus

_ENV_ID, _RUN = "Hopper-v5", "bench"
_PATIENCE_S, _LOOK_EVERY_S = 120.0, 0.002
_MIB = 1024.0


def contests(stack: ExitStack) -> list[Contest]:
    """Open what a starting actor meets."""
    learner, actors = _StartedLearner(), _StartedActor(stack)
    return [
        Contest("s", [Contender("a2s --help", _help)], is_reading=True),
        Contest("s", [Contender("actor: to its first step", actors.start)], is_reading=True),
        Contest(
            "MiB",
            [
                Contender("supervisor: resident", lambda: actors.supervisor_mib),
                Contender("worker: resident", lambda: actors.worker_mib),
            ],
            is_reading=True,
        ),
        Contest("s", [Contender("learner: until it listens", learner.start)], is_reading=True),
        Contest("MiB", [Contender("learner: resident", lambda: learner.mib)], is_reading=True),
    ]


def _help() -> float:
    begin_s = perf_counter()
    subprocess.run([*PROGRAM, "--help"], check=True, stdout=subprocess.DEVNULL)
    return perf_counter() - begin_s


class _StartedActor:
    """Starts ``a2s actor --n 1`` for a learner that wants a single step at a time."""

    def __init__(self, stack: ExitStack) -> None:
        torch.set_num_threads(1)
        with closing(Environment(EnvConfig(env_id=_ENV_ID))) as environment:
            self._spaces = environment.spaces
        self._graph = graph(self._spaces, 10)
        self._notice = Notice(
            generation=1, epoch=0, version=1, quota_steps=1, quota_episodes=0,
            num_bytes=len(self._graph), sha256=hashlib.sha256(self._graph).hexdigest(),
        )  # fmt: skip
        self._has_stepped = threading.Event()
        self._endpoint, keys = free_endpoint(), Keys(_RUN)
        bus = stack.enter_context(closing(ZenohBus.listen(self._endpoint)))
        bus.answer(keys.hello, self._welcome)
        bus.answer(keys.notice, lambda _: encode(self._notice))
        weights = encode(Weights(notice=self._notice, graph=self._graph))
        bus.answer(keys.weights, lambda _: weights)
        bus.answer(keys.segment, self._take)
        bus.declare_presence(keys.live_learner)
        self.supervisor_mib = self.worker_mib = 0.0

    def start(self) -> float:
        """Seconds until its first step is here."""
        self._has_stepped.clear()
        command = ["actor", "--n", "1", "--run", _RUN, "--connect", self._endpoint]
        begin_s = perf_counter()
        process = _started([*command, "--metrics-port", "-1"])
        try:
            if not self._has_stepped.wait(_PATIENCE_S):
                raise A2SError(f"bench startup: no step in {_PATIENCE_S:.0f} s")
            spent_s = perf_counter() - begin_s
            self.supervisor_mib = _resident_mib(process.pid)
            self.worker_mib = max(map(_resident_mib, _children_of(process.pid)))
        finally:
            process.terminate()
            process.wait()
        return spent_s

    def _welcome(self, payload: bytes) -> bytes:
        joins = decode(payload, Hello).spaces is not None
        return encode(
            Welcome(
                run=_RUN, generation=1, env_id=_ENV_ID, spaces=self._spaces, num_envs=8,
                clock="async", slot=0 if joins else -1, seed=1,
            )
        )  # fmt: skip

    def _take(self, _: bytes) -> bytes:
        self._has_stepped.set()
        return encode(
            Ack(
                verdict="accepted", reason="", generation=1, epoch=0, weights_version=1,
                wait_s=1.0,
            )
        )  # fmt: skip


class _StartedLearner:
    """Starts ``a2s learner``."""

    def __init__(self) -> None:
        self.mib = 0.0

    def start(self) -> float:
        """Seconds until it listens."""
        endpoint = free_endpoint()
        port = int(endpoint.rsplit(":", 1)[1])
        with tempfile.TemporaryDirectory() as folder:
            command = ["learner", "--env", _ENV_ID, "--listen", endpoint, "--metrics-port", "-1"]
            begin_s = perf_counter()
            process = _started([*command, "--run-dir", f"{folder}/run"])
            try:
                _wait_for(port)
                spent_s = perf_counter() - begin_s
                self.mib = _resident_mib(process.pid)
            finally:
                process.terminate()
                process.wait()
        return spent_s


def _started(options: list[str]) -> "subprocess.Popen[bytes]":
    nowhere = subprocess.DEVNULL
    return subprocess.Popen([*PROGRAM, *options], stdout=nowhere, stderr=nowhere)


def _wait_for(port: int) -> None:
    give_up_s = monotonic() + _PATIENCE_S
    while monotonic() < give_up_s:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        sleep(_LOOK_EVERY_S)
    raise A2SError(f"bench startup: no learner in {_PATIENCE_S:.0f} s")


def _children_of(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task")
    found = [(tasks / task / "children").read_text().split() for task in os.listdir(tasks)]
    return [int(child) for children in found for child in children]


def _resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return float(status.split("VmRSS:")[1].split()[0]) / _MIB
