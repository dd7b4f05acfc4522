"""The newest two hours of a run's metrics, in memory."""

import math
import threading
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from prometheus_client.metrics_core import Metric

EVERY_S = 2.0
_CAPACITY = 3600  # two hours
_MOST_AT_ONCE = 720  # what a page is given at first: five points a minute
_PREFIX, _CREATED, _INFO = "a2s_", "_created", "a2s_run_info"
_TIME = "_timestamp_seconds"
_SHOWN = ("gauge", "counter")


class History:
    """Samples of one run by name, at the times when they were taken; threads may share it.

    Attributes:
        place: Where the run is, for one that has not told its name.
        about: Labels of ``a2s_run_info``: ``run``, ``env_id``, ``algo`` and ``seed``.
        is_up: Whether the latest samples could be taken.
    """

    def __init__(self, place: str = "", capacity: int = _CAPACITY) -> None:
        self.place = place
        self.about: dict[str, str] = {}
        self.is_up = False
        self._lock = threading.Lock()
        self._capacity, self._count = capacity, 0
        self._times = np.full(capacity, np.nan)
        self._series: dict[str, np.ndarray[Any, np.dtype[np.float64]]] = {}

    def take(self, now_s: float, families: Iterable[Metric], ahead_s: float = 0.0) -> None:
        """Take the present values of gauges and counters, at ``now_s`` seconds since 1970.

        Those that are times are of a clock that is ``ahead_s`` seconds ahead of this one.
        """
        found, about = _flat(families)
        found |= {name: value - ahead_s for name, value in found.items() if _TIME in name}
        self.add(now_s, found)
        self.about, self.is_up = about or self.about, True

    def add(self, now_s: float, samples: Mapping[str, float]) -> None:
        """Append values; the oldest give way. What is missing has no value at this time."""
        with self._lock:
            place = self._count % self._capacity
            self._times[place] = now_s
            for name in samples.keys() - self._series.keys():
                self._series[name] = np.full(self._capacity, np.nan)
            for name, series in self._series.items():
                series[place] = samples.get(name, math.nan)
            self._count += 1

    def since(self, since_s: float) -> dict[str, Any]:
        """Give the times after ``since_s``, thinned out where they are many, and the values then.

        A value that is missing or not finite is ``None``.
        """
        with self._lock:
            last = np.arange(max(0, self._count - self._capacity), self._count) % self._capacity
            last = last[self._times[last] > since_s]
            step = math.ceil(len(last) / _MOST_AT_ONCE) or 1
            last = last[::-1][::step][::-1]  # the newest is always there
            series = {name: _plain(values[last]) for name, values in self._series.items()}
            return {"t": self._times[last].tolist(), "series": series}


def _plain(values: np.ndarray[Any, np.dtype[np.float64]]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]


def _flat(families: Iterable[Metric]) -> tuple[dict[str, float], dict[str, str]]:
    """Names with labels, as ``/metrics`` writes them, to values; and what the run is."""
    found: dict[str, float] = {}
    about: dict[str, str] = {}
    for family in families:
        for sample in family.samples:
            if sample.name == _INFO:
                about = dict(sample.labels)
            elif family.type in _SHOWN and _is_ours(sample.name):
                labels = ",".join(f'{k}="{v}"' for k, v in sorted(sample.labels.items()))
                found[f"{sample.name}{{{labels}}}" if labels else sample.name] = sample.value
    return found, about


def _is_ours(name: str) -> bool:
    return name.startswith(_PREFIX) and not name.endswith(_CREATED)
