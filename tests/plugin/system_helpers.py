"""What the tests of real processes share."""

import signal
import subprocess
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
from prometheus_client.parser import text_string_to_metric_families

FAST = (
    "--set", "batch_steps=256", "--set", "first_batch_steps=256", "--set", "critic_epochs=1",
    "--set", "policy_epochs=1", "--envs", "2",
)  # fmt: skip
# Any batch worse than the best may lead to a recovery, and small batches of a policy that learns
# nothing (its step is tiny) differ by chance: there will be some.
OFTEN = (
    "--set", "batch_steps=64", "--set", "first_batch_steps=64", "--set", "learning_rate=1e-9",
    "--set", "lr_rule=constant", "--set", "recovery=invariant", "--set", "recovery_bias=0",
    "--set", "recovery_episodes=0", "--set", "recovery_statistic=mean",
    "--set", "recovery_cool_down=0",
)  # fmt: skip
# Off-policy: small networks and batches, which are due soon.
OFF_POLICY = (
    "--variant", "off-policy", "--envs", "2", "--set", "critic_sizes=16,16",
    "--set", "policy_sizes=16,16", "--set", "batch_rows=32", "--set", "send_every_steps=8",
    "--set", "replay_rows=20000",
)  # fmt: skip
REACH = ("--env", "a2s_test_envs:Reach-v0")
PATIENCE_S = 200.0  # for whole runs, on a busy machine too: only a failure takes so long


@dataclass
class Command:
    """One ``a2s`` command that was started.

    Attributes:
        process: Its process.
        log: Where all that it prints goes.
    """

    process: "subprocess.Popen[bytes]"
    log: Path

    def text(self) -> str:
        """What it has printed so far."""
        return self.log.read_text()

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait for the end."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def workers(self) -> list[psutil.Process]:
        """The living worker processes below it."""
        found = psutil.Process(self.process.pid).children(recursive=True)
        alive = [p for p in found if is_alive(p.pid) and _is_worker(p)]
        # What a worker has forked has its command line.
        return [p for p in alive if not any(_is_worker(q) for q in _parents(p))]


def _parents(process: psutil.Process) -> list[psutil.Process]:
    """Those of a process; none if it has just ended."""
    try:
        return process.parents()
    except psutil.NoSuchProcess:
        return []


def _is_worker(process: psutil.Process) -> bool:
    """Whether a process is a living worker, or was forked by one."""
    try:
        return "a2s.actors.worker" in " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return False


Start = Callable[..., Command]


def scrape(port: int) -> dict[str, float]:
    """Read /metrics: ``name{label="value"}`` to value, labels in alphabetical order."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as reply:
        text = reply.read().decode()
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(f'{k}="{v}"' for k, v in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}" if labels else sample.name] = sample.value
    return found


def metrics_port(command: Command) -> int:
    """The port that a command says it serves metrics on."""
    line = next(x for x in command.text().splitlines() if "/metrics" in x)
    return int(line.rsplit(":", 1)[1].split("/")[0])


def rows(path: Path, *, without: str) -> list[str]:
    """Lines of a CSV file without one column."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    skip = lines[0].index(without)
    return [",".join(c for i, c in enumerate(line) if i != skip) for line in lines]


def is_alive(pid: int) -> bool:
    """Whether a process exists and is not a zombie."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
