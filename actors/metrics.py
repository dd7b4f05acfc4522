"""The Prometheus metrics of actors; ``docs/metrics.md`` explains every name.

Worker processes report their samples to the supervisor, which serves the sums: one port serves
all, a replaced worker's counters go on, and an environment that forks or closes cannot change them.
"""

import contextlib
import math
import os
import threading
import time
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    disable_created_metrics,
    start_http_server,
)
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from a2s import __version__
from a2s.protocol.keys import MAJOR
from a2s.protocol.serving import not_served

_FAST_S = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2)
_SLOW_S = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 5e-2, 0.1, 0.5, 1.0, 5.0, 10.0)
_STEPS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000)

# A value under its metric, its series, and name and value of its label, if it has one.
Sample = tuple[list[str], float]
_Totals = dict[tuple[str, ...], float]


class ActorMetrics:
    """The metrics of one worker process, in a registry of their own."""

    def __init__(self) -> None:
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self.registry = CollectorRegistry()
        self._cpu_s = 0.0
        self._make_counters()
        self._make_gauges()
        self.episode_length = self._histogram(
            "episode_length_steps", "Lengths of episodes.", _STEPS
        )
        self.env_step_seconds = self._histogram(
            "env_step_seconds", "Time of one environment step.", _FAST_S
        )
        self.select_seconds = self._histogram(
            "select_seconds", "Time of one batched call: K suggestions, their Q, the selection.",
            _FAST_S,
        )  # fmt: skip
        self.send_seconds = self._histogram(
            "send_seconds", "Time from sending a segment to its answer.", _SLOW_S
        )

    def _make_counters(self) -> None:
        self.env_steps = self._counter("env_steps", "Environment steps made.")
        self.episodes = self._counter("episodes", "Finished episodes.", end="terminated truncated")
        self.recoveries = self._counter(
            "recovery_events", "Recoveries of the learner that this actor followed."
        )
        self.messages_sent = self._counter(
            "messages_sent", "Segments put on the wire, resent ones included."
        )
        self.sent_bytes = self._counter("sent_bytes", "Bytes of segments put on the wire.")
        self.acks = self._counter(
            "acks", "Answers of the learner by verdict.", result="accepted duplicate stale refused"
        )
        self.retries = self._counter("retries", "Segments sent again because there was no answer.")
        self.dropped = self._counter(
            "dropped_transitions", "Transitions lost on purpose.", reason="malformed shutdown"
        )
        self.weights_received_bytes = self._counter(
            "weights_received_bytes", "Bytes of weights received."
        )
        self.seconds = self._counter(
            "seconds", "Where the time of the worker goes.",
            doing="environment selection sending waiting",
        )  # fmt: skip
        self.evaluations = self._counter("evaluations", "Evaluations that were played.")
        self.joins = self._counter("joins", "Times that this actor joined a learner.")
        self.cpu_seconds = self._counter("cpu_seconds", "Processor time of the worker process.")

    def _make_gauges(self) -> None:
        self.episode_return_last = self._gauge(
            "episode_return_last", "Return of the latest episode."
        )
        self.q_spread = self._gauge(
            "suggestion_q_spread", "Highest minus mean Q over the suggestions, latest call."
        )
        self.outbox = self._gauge("outbox_transitions", "Transitions that wait for an answer.")
        self.outbox_capacity = self._gauge(
            "outbox_capacity_transitions", "Transitions that may wait for an answer."
        )
        self.epoch = self._gauge(
            "epoch", "Recovery epoch acted in: the recoveries that have reached this actor."
        )
        self.weights_version = self._gauge("weights_version", "Version of the weights in use.")
        self.weights_received = self._gauge(
            "weights_received_timestamp_seconds", "When the weights in use arrived."
        )
        self.memory = self._gauge("resident_memory_bytes", "Memory of the worker process.")

    def _counter(self, name: str, text: str, **label: str) -> Counter:
        """Make a counter; the values of its label are exported from the start."""
        counter = Counter(f"a2s_actor_{name}", text, [*label], registry=self.registry)
        for values in label.values():
            for value in values.split():
                counter.labels(value)
        return counter

    def _gauge(self, name: str, text: str) -> Gauge:
        """Make a gauge that is NaN, and is not exported, until it has a value."""
        gauge = Gauge(f"a2s_actor_{name}", text, registry=self.registry)
        gauge.set(math.nan)
        return gauge

    def _histogram(self, name: str, text: str, buckets: tuple[float, ...]) -> Histogram:
        return Histogram(f"a2s_actor_{name}", text, buckets=buckets, registry=self.registry)

    @contextlib.contextmanager
    def spending(self, doing: str) -> Iterator[None]:
        """Count the time of a block, by a value of the label ``doing``."""
        begin_s = time.monotonic()
        yield
        self.seconds.labels(doing).inc(time.monotonic() - begin_s)

    def spent(self) -> dict[str, float]:
        """Seconds so far by what they went into, by the values of the label ``doing``."""
        samples = (sample for metric in self.seconds.collect() for sample in metric.samples)
        return {sample.labels["doing"]: sample.value for sample in samples}

    def report(self) -> dict[str, Any]:
        """Give all counts, and how often something useful was done."""
        accepted = total(self.acks.labels("accepted")) + total(self.evaluations)
        return {"samples": self.samples(), "accepted": accepted}

    def samples(self) -> list[Sample]:
        """Give all counts, and the resources that this process uses."""
        cpu_s = time.process_time()
        self.cpu_seconds.inc(cpu_s - self._cpu_s)
        self._cpu_s = cpu_s
        self.memory.set(_resident_bytes())
        return [
            ([metric.name, sample.name, *chain(*sample.labels.items())], sample.value)
            for metric in self.registry.collect()
            for sample in metric.samples
            if not math.isnan(sample.value)
        ]


def total(counter: Counter) -> float:
    """Read a counter, summed over its label."""
    return sum(sample.value for metric in counter.collect() for sample in metric.samples)


class Fleet(Collector):
    """The metrics of all workers of one ``a2s actor``, labelled with ``worker``.

    ``registry`` has these, those of the supervisor and those of its process.
    """

    def __init__(self, num_workers: int) -> None:
        nothing = ActorMetrics()
        self._metrics = list(nothing.registry.collect())
        self._gauges = {metric.name for metric in self._metrics if metric.type == "gauge"}
        self._lock = threading.Lock()
        self._present: list[_Totals] = [{} for _ in range(num_workers)]
        zeros = {tuple(key): 0.0 for key, _ in nothing.samples() if key[0] not in self._gauges}
        self._past: list[_Totals] = [zeros] * num_workers
        self.registry = CollectorRegistry()
        build = Info("a2s_build", "What runs here.", registry=self.registry)
        build.info({"version": __version__, "protocol": str(MAJOR)})
        self.registry.register(self)
        self._up = Gauge(
            "a2s_actor_worker_up", "Whether the worker process has reported.", ["worker"],
            registry=self.registry,
        )  # fmt: skip
        self._restarts = Counter(
            "a2s_actor_restarts", "Worker processes that were replaced.", ["worker"],
            registry=self.registry,
        )  # fmt: skip
        for worker in range(num_workers):
            self._up.labels(worker)
            self._restarts.labels(worker)
        ProcessCollector(registry=self.registry)

    def update(self, worker: int, samples: Iterable[Sample]) -> None:
        """Take the newest samples of a worker."""
        with self._lock:
            self._present[worker] = {tuple(key): value for key, value in samples}
        self._up.labels(worker).set(1)

    def ended(self, worker: int) -> None:
        """A worker process ended: keep its counts, but not its state."""
        with self._lock:
            counted = self._sum(worker).items()
            self._past[worker] = {k: value for k, value in counted if k[0] not in self._gauges}
            self._present[worker] = {}
        self._up.labels(worker).set(0)

    def restarted(self, worker: int) -> None:
        """A worker process was replaced."""
        self._restarts.labels(worker).inc()

    def collect(self) -> Iterator[Metric]:
        """Give, for each worker, the sums of all its processes so far."""
        found = {m.name: Metric(m.name, m.documentation, m.type) for m in self._metrics}
        with self._lock:
            for worker in range(len(self._past)):
                for (metric, series, *label), value in self._sum(worker).items():
                    labels = {"worker": str(worker), **dict([label] if label else [])}
                    found[metric].add_sample(series, labels, value)
        yield from found.values()

    def _sum(self, worker: int) -> _Totals:
        past, present = self._past[worker], self._present[worker]
        return {key: past.get(key, 0.0) + present.get(key, 0.0) for key in past | present}


def _resident_bytes() -> float:
    """Memory of this process; 0 while an environment has all file descriptors."""
    with contextlib.suppress(OSError), open("/proc/self/statm", "rb") as statm:
        return float(int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    return 0.0


def serve(fleet: Fleet, host: str, port: int) -> int:
    """Serve the metrics over HTTP.

    Returns:
        The port, which is a free one when ``port`` is 0.

    Raises:
        UsageError: The port is taken, or the host is not this machine.
    """
    try:
        server, _ = start_http_server(port, addr=host, registry=fleet.registry)
    except (OSError, UnicodeError) as error:
        raise not_served(host, port, "--metrics-port", error) from None
    return int(server.server_port)
