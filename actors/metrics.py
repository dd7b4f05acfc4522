"""What an actor counts, and how ``a2s actor`` shows the counts of all its processes to Prometheus.

A worker process keeps a :class:`Tally` and sends a snapshot through a pipe. The supervisor exports
the sum of what each worker place has ever counted, so counters never fall when a process is
replaced. ``docs/metrics.md`` explains every name.
"""

import bisect
import contextlib
import os
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
)
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from a2s import __version__
from a2s.protocol.codec import SCHEMA_VERSION
from a2s.protocol.errors import UsageError

Snapshot = dict[str, Any]
_FAST_S = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2)
_SLOW_S = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2, 0.1, 0.5, 1.0, 5.0, 10.0)
_VERDICTS = ("accepted", "duplicate", "stale", "refused")
_LOST = ("malformed", "shutdown")
_STEPS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


class _Described(NamedTuple):
    help: str
    label: str | None = None
    values: tuple[str, ...] = ("",)
    buckets: tuple[float, ...] = ()


COUNTERS = {
    "env_steps": _Described("Environment steps made."),
    "episodes": _Described("Finished episodes.", "end", ("terminated", "truncated")),
    "recovery_events": _Described("Recoveries of the learner that this actor followed."),
    "messages_sent": _Described("Segments put on the wire, resent ones included."),
    "sent_bytes": _Described("Bytes of segments put on the wire."),
    "acks": _Described("Answers of the learner by verdict.", "result", _VERDICTS),
    "retries": _Described("Segments sent again because there was no answer."),
    "dropped_transitions": _Described("Transitions lost on purpose.", "reason", _LOST),
    "weights_received_bytes": _Described("Bytes of weights received."),
    "joins": _Described("Times that this actor joined a learner."),
    "cpu_seconds": _Described("Processor time of the worker process."),
}
GAUGES = {
    "episode_return_last": _Described("Return of the latest episode."),
    "suggestion_q_spread": _Described("Highest minus mean Q over the suggestions, latest call."),
    "outbox_transitions": _Described("Transitions that wait for an answer."),
    "outbox_capacity_transitions": _Described("Transitions that may wait for an answer."),
    "epoch": _Described("Recovery epoch acted in: the recoveries that have reached this actor."),
    "weights_version": _Described("Version of the weights in use."),
    "weights_received_timestamp_seconds": _Described("When the weights in use arrived."),
    "resident_memory_bytes": _Described("Memory of the worker process."),
}
HISTOGRAMS = {
    "episode_length_steps": _Described("Lengths of episodes.", buckets=_STEPS),
    "env_step_seconds": _Described("Time of one environment step.", buckets=_FAST_S),
    "select_seconds": _Described(
        "Time of one batched call: K suggestions, their Q, the selection.", buckets=_FAST_S
    ),
    "send_seconds": _Described("Time from sending a segment to its answer.", buckets=_SLOW_S),
}


class Tally:
    """The counts of one worker process. Any thread may count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        nothing = _nothing()
        self._counters: dict[str, dict[str, float]] = nothing["counters"]
        self._gauges: dict[str, float] = nothing["gauges"]
        self._histograms: dict[str, list[float]] = nothing["histograms"]

    def count(self, name: str, amount: float = 1, **label: str) -> None:
        """Add to a counter, under the value of its label if it has one."""
        value = next(iter(label.values()), "")
        with self._lock:
            counter = self._counters[name]
            counter[value] = counter.get(value, 0.0) + amount

    def gauge(self, name: str, value: float) -> None:
        """Set a gauge."""
        self._gauges[name] = value

    def observe(self, name: str, value: float) -> None:
        """Add a value to a histogram."""
        place = bisect.bisect_left(HISTOGRAMS[name].buckets, value)
        with self._lock:
            row = self._histograms[name]
            row[place] += 1
            row[-1] += value

    def episode(self, episode_return: float, length: int, *, terminated: bool) -> None:
        """Count a finished episode."""
        self.count("episodes", end="terminated" if terminated else "truncated")
        self.gauge("episode_return_last", episode_return)
        self.observe("episode_length_steps", length)

    def total(self, name: str) -> float:
        """Read a counter, summed over its label."""
        with self._lock:
            return sum(self._counters[name].values())

    def snapshot(self) -> Snapshot:
        """Copy everything, and what this process uses by now, as plain JSON."""
        with self._lock:
            self._counters["cpu_seconds"] = {"": time.process_time()}
            self._gauges["resident_memory_bytes"] = _resident_bytes()
            return {
                "counters": {name: dict(values) for name, values in self._counters.items()},
                "gauges": dict(self._gauges),
                "histograms": {name: list(row) for name, row in self._histograms.items()},
            }


class Fleet(Collector):
    """The counts of all workers of one ``a2s actor``, for Prometheus.

    Args:
        num_workers: Worker places; each is a value of the label ``worker``.
    """

    def __init__(self, num_workers: int) -> None:
        self._lock = threading.Lock()
        self._past = [_nothing() for _ in range(num_workers)]
        self._present: list[Snapshot | None] = [None] * num_workers
        self._restarts = [0] * num_workers

    def update(self, worker: int, snapshot: Snapshot) -> None:
        """Take the newest snapshot of a worker."""
        with self._lock:
            self._present[worker] = snapshot

    def ended(self, worker: int) -> None:
        """A worker process ended: keep what it counted, not the state that it was in."""
        with self._lock:
            merged = _merge(self._past[worker], self._present[worker])
            self._past[worker] = {**merged, "gauges": {}}
            self._present[worker] = None

    def restarted(self, worker: int) -> None:
        """A worker process was replaced."""
        with self._lock:
            self._restarts[worker] += 1

    def collect(self) -> Iterator[Metric]:
        """Yield every metric with the label ``worker``."""
        with self._lock:
            now = [_merge(*pair) for pair in zip(self._past, self._present, strict=True)]
            up = [float(present is not None) for present in self._present]
            restarts = list(self._restarts)
        build = {"version": __version__, "protocol": str(SCHEMA_VERSION)}
        yield InfoMetricFamily("a2s_build", "What runs here.", build)
        for name, described in COUNTERS.items():
            labels = ["worker", described.label] if described.label else ["worker"]
            counter = CounterMetricFamily(f"a2s_actor_{name}", described.help, labels=labels)
            for worker, snapshot in enumerate(now):
                counted = dict.fromkeys(described.values, 0.0) | snapshot["counters"][name]
                for value, amount in counted.items():
                    counter.add_metric([str(worker), value][: len(labels)], amount)
            yield counter
        for name, described in GAUGES.items():
            yield _gauge(name, described.help, [s["gauges"].get(name) for s in now])
        for name, described in HISTOGRAMS.items():
            yield _histogram(name, described, [s["histograms"][name] for s in now])
        yield _gauge("worker_up", "Whether the worker process has reported.", up)
        restarted = CounterMetricFamily(
            "a2s_actor_restarts", "Worker processes that were replaced.", labels=["worker"]
        )
        for worker, amount in enumerate(restarts):
            restarted.add_metric([str(worker)], amount)
        yield restarted


def _nothing() -> Snapshot:
    return {
        "counters": {name: {} for name in COUNTERS},
        "gauges": {},
        "histograms": {
            name: [0.0] * (len(described.buckets) + 2) for name, described in HISTOGRAMS.items()
        },
    }


def _resident_bytes() -> float:
    """Memory of this process; 0 while an environment has all file descriptors."""
    with contextlib.suppress(OSError), open("/proc/self/statm", "rb") as statm:
        return float(int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    return 0.0


def _gauge(name: str, help_text: str, values: Sequence[float | None]) -> GaugeMetricFamily:
    gauge = GaugeMetricFamily(f"a2s_actor_{name}", help_text, labels=["worker"])
    for worker, value in enumerate(values):
        if value is not None:
            gauge.add_metric([str(worker)], value)
    return gauge


def _histogram(name: str, described: _Described, rows: list[list[float]]) -> HistogramMetricFamily:
    histogram = HistogramMetricFamily(f"a2s_actor_{name}", described.help, labels=["worker"])
    bounds = [*(repr(float(b)) for b in described.buckets), "+Inf"]
    for worker, row in enumerate(rows):
        cumulative, total = [], 0.0
        for bound, amount in zip(bounds, row[:-1], strict=True):
            total += amount
            cumulative.append((bound, total))
        histogram.add_metric([str(worker)], cumulative, sum_value=row[-1])
    return histogram


def _merge(past: Snapshot, present: Snapshot | None) -> Snapshot:
    if present is None:
        return past
    counters = {
        name: {
            value: past["counters"][name].get(value, 0.0) + new.get(value, 0.0)
            for value in {**past["counters"][name], **new}
        }
        for name, new in present["counters"].items()
    }
    histograms = {
        name: [a + b for a, b in zip(past["histograms"][name], row, strict=True)]
        for name, row in present["histograms"].items()
    }
    return {"counters": counters, "gauges": present["gauges"], "histograms": histograms}


def serve(fleet: Fleet, host: str, port: int) -> int:
    """Serve the metrics over HTTP.

    Returns:
        The port, which is a free one when ``port`` is 0.

    Raises:
        UsageError: The port is taken.
    """
    registry = CollectorRegistry()
    registry.register(fleet)
    ProcessCollector(registry=registry)
    try:
        server, _ = start_http_server(port, addr=host, registry=registry)
    except OSError as error:
        raise UsageError(
            f"metrics port {port}: {error.strerror}; choose another with --metrics-port, 0 = any"
        ) from None
    return int(server.server_port)
