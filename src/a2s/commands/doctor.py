"""``a2s doctor``: whether this machine can train, and the way to the learner, with remedies."""

import os
import platform
import shutil
import socket
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

from a2s import __version__
from a2s.actors.check import check
from a2s.commands.process import ACTOR_METRICS_PORT, LEARNER_METRICS_PORT, cores_here
from a2s.commands.rendering import HELP, find_backend
from a2s.commands.status import ask
from a2s.protocol.access import ACTOR, LEARNER, VIEWER
from a2s.protocol.env_config import EnvConfig
from a2s.protocol.errors import (
    A2SError,
    MalformedMessageError,
    RefusedError,
    UnreachableError,
    UsageError,
)
from a2s.protocol.identity import Identity, Security
from a2s.protocol.keys import DEFAULT_ENDPOINT, Keys, other_runs
from a2s.protocol.zenoh_bus import ZenohBus

State = Literal["ok", "note", "fail"]
_TRIED = "Hopper-v5"
_LEAST_FREE, _FEW_FREE = 200e6, 2e9
_LEAST_MEMORY = 2e9
_MOST_SKEW_S = 5.0
_EXPIRES_SOON = timedelta(days=30)
_REACH_S, _ASKED = 2.0, 5


class Finding(NamedTuple):
    """The result of one check; what is not ``ok`` has a remedy."""

    name: str
    state: State
    found: str
    remedy: str = ""


def examine(connect: str | None, run: str, security: Security) -> Iterator[Finding]:
    """Make all checks; those that take long come last."""
    yield _python()
    yield _packages()
    yield _cores()
    yield _memory()
    yield _disk(Path.cwd())
    yield from _ports()
    yield from _security(security, connect, run)
    yield _environments()
    yield _rendering()


def line(finding: Finding) -> str:
    """Write a finding for a reader."""
    text = f"{finding.state:<5} {finding.name:<13} {finding.found}"
    return f"{text}\n{'':<20}-> {finding.remedy}" if finding.remedy else text


def _python() -> Finding:
    found = f"{platform.python_version()}, a2s {__version__}, {platform.system()}"
    if sys.platform != "linux":
        return Finding("python", "fail", found, "a2s runs on Linux; use a virtual machine or WSL")
    return Finding("python", "ok", found)


def _packages() -> Finding:
    """Compare what is installed with what a2s asks for; the learner's where torch is there."""
    from packaging.requirements import Requirement

    has_learner = _version("torch") is not None
    extras = ("", "learner") if has_learner else ("",)
    wrong, count = [], 0
    for text in metadata.requires("a2s") or ():
        need = Requirement(text)
        if need.marker and not any(need.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        found = _version(need.name)
        if found is None or not need.specifier.contains(found, prereleases=True):
            wrong.append(f"{need.name} {found or 'missing'}, expected {need.specifier or 'any'}")
        count += 1
    wanted = "a2s[learner]" if has_learner else "a2s"
    if wrong:
        return Finding("packages", "fail", "; ".join(wrong), f"pip install -U '{wanted}'")
    if not has_learner:
        remedy = "this machine can act; to learn or train: pip install 'a2s[learner]'"
        return Finding("packages", "note", f"{count} as required, no torch", remedy)
    return Finding("packages", "ok", f"{count} as required")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _cores() -> Finding:
    count = cores_here()
    quota = _cgroup("cpu.max")
    if quota and quota[0] != "max":
        count = min(count, max(1, int(quota[0]) // int(quota[1])))
    found = f"{count} of {os.cpu_count()}"
    if count < 2:
        return Finding("cores", "note", found, "learner and actors take turns; two are faster")
    return Finding("cores", "ok", found)


def _memory() -> Finding:
    lines = Path("/proc/meminfo").read_text().splitlines()
    free = next(float(each.split()[1]) * 1024 for each in lines if each.startswith("MemAvailable"))
    limit = _cgroup("memory.max")
    if limit and limit[0] != "max":
        free = min(free, float(limit[0]))
    found = f"{free / 1e9:.1f} GB free"
    if free < _LEAST_MEMORY:
        remedy = "a learner takes 1 GB, an actor 0.25: fewer actors, or --set replay_rows=200000"
        return Finding("memory", "note", found, remedy)
    return Finding("memory", "ok", found)


def _cgroup(name: str) -> list[str]:
    file = Path("/sys/fs/cgroup") / name
    return file.read_text().split() if file.exists() else []


def _disk(place: Path) -> Finding:
    free = shutil.disk_usage(place).free
    found = f"{free / 1e9:.1f} GB free in {place}"
    if not os.access(place, os.W_OK):
        return Finding("disk", "fail", f"{place} is read only", "change to another directory")
    if free < _LEAST_FREE:
        return Finding("disk", "fail", found, "make room, or name another place with --run-dir")
    if free < _FEW_FREE:
        return Finding("disk", "note", found, "a full off-policy replay takes up to 2 GB")
    return Finding("disk", "ok", found)


def _ports() -> Iterator[Finding]:
    """Look at the ports that commands listen on by default."""
    usual = int(DEFAULT_ENDPOINT.rpartition(":")[2])
    yield port(usual, f"a2s learner --listen tcp/127.0.0.1:{usual + 1}, and actors --connect to it")
    for number in (LEARNER_METRICS_PORT, ACTOR_METRICS_PORT):
        yield port(number, "nothing to do: metrics take another one, and print it")


def port(number: int, remedy: str) -> Finding:
    """See whether a port on loopback is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
        except OSError as error:
            return Finding("port", "note", f"{number}: {error.strerror}; perhaps a run", remedy)
    return Finding("port", "ok", f"{number} is free")


def _security(security: Security, connect: str | None, run: str) -> Iterator[Finding]:
    """Look at the certificate or user, then go the way to the learner."""
    try:
        endpoint = security.endpoint(connect or DEFAULT_ENDPOINT)
        identity = security.peer(VIEWER, ACTOR, LEARNER)
    except UsageError as error:
        found, _, remedy = str(error).rpartition("; ")
        yield Finding("identity", "fail", found or remedy, remedy if found else "")
        return
    if identity.folder is not None:
        yield certificate(identity.folder, datetime.now(UTC))
    elif identity.name:
        yield Finding("identity", "ok", f"user {identity.name}")
    yield from _learner(endpoint, identity, run, is_needed=connect is not None)


def certificate(folder: Path, now: datetime) -> Finding:
    """Look how long a certificate is valid."""
    from a2s.protocol.certificates import read

    held = read(folder, now)
    found = f"{held.name}, a certificate until {held.expires:%Y-%m-%d}"
    if held.expires - now < _EXPIRES_SOON:
        remedy = "make a new one with `a2s certs` where the authority is, and copy it here"
        return Finding("identity", "note", found, remedy)
    return Finding("identity", "ok", found)


def _learner(endpoint: str, identity: Identity, run: str, *, is_needed: bool) -> Iterator[Finding]:
    """Go the way to the learner step by step."""
    try:
        bus = ZenohBus.connect(endpoint, lambda: False, identity)
    except RefusedError as error:
        found, _, remedy = str(error).rpartition("; ")
        yield Finding("learner", "fail", found, remedy)
        return
    except UnreachableError:
        remedy = f"start `a2s learner` there, with --listen; {_reach(endpoint)}"
        state: State = "fail" if is_needed else "note"
        yield Finding("learner", state, f"none at {endpoint}", remedy)
        return
    waits_s = []
    with closing(bus):
        for _ in range(_ASKED):
            begin_s = time.monotonic()
            try:
                told = ask(bus, Keys(run))
            except MalformedMessageError as error:
                remedy = "install the same release on both machines"
                yield Finding("learner", "fail", str(error), remedy)
                return
            if told is None:
                others = other_runs(bus, run)
                found = f"{endpoint}: connected, no answer for run {run!r}{others}"
                remedy = "name the run with --run; a release of another protocol is silent, too"
                yield Finding("learner", "fail", found, remedy)
                return
            waits_s.append(time.monotonic() - begin_s)
    assert told is not None  # it was asked
    wait_ms = 1e3 * statistics.median(waits_s)
    yield Finding("learner", "ok", f"run {told.run}, {told.env_id}, answers in {wait_ms:.1f} ms")
    yield clock(time.time(), told.unix_s)


def clock(now_s: float, learners_s: float) -> Finding:
    """Compare the clocks of two machines, seconds since 1970; 0: not told."""
    skew_s = now_s - learners_s
    if not learners_s:
        return Finding("clock", "note", "not told", "the learner is of an earlier release")
    if abs(skew_s) > _MOST_SKEW_S:
        found = f"{abs(skew_s):.0f} s {'ahead of' if skew_s > 0 else 'behind'} the learner's"
        return Finding("clock", "note", found, "set both by NTP; else logs do not fit together")
    return Finding("clock", "ok", "as the learner's")


def _reach(endpoint: str) -> str:
    """Say how far plain TCP comes."""
    host, _, number = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(number)), timeout=_REACH_S):
            return "something else answers on that port"
    except socket.gaierror:
        return f"the name {host} is unknown here"
    except TimeoutError:
        return "packets are dropped on the way: a firewall, or a wrong address"
    except OSError as error:
        return f"TCP says: {error.strerror}"


def _environments() -> Finding:
    try:
        tried = check(EnvConfig(env_id=_TRIED), lambda _words: None)
    except A2SError as error:
        return Finding("environments", "fail", str(error), "pip install -U 'gymnasium[mujoco]'")
    found = f"{_TRIED}, {tried['steps_per_s']:,.0f} steps/s at random in one process"
    return Finding("environments", "ok", found)


def _rendering() -> Finding:
    backend = find_backend()
    if backend is not None:
        return Finding("rendering", "ok", f"MUJOCO_GL={backend}")
    return Finding("rendering", "note", "neither EGL nor OSMesa draws", f"for videos alone: {HELP}")
