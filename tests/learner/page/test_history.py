"""The live page's history: the newest two hours, whole or thinned, numbers only."""

import math

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info

from a2s.learner.page.history import History


def test_it_gives_what_is_newer_and_keeps_the_newest() -> None:
    history = History(capacity=3)
    for second in range(1, 6):
        history.add(float(second), {"x": 10.0 * second})
    assert history.since(0.0) == {"t": [3.0, 4.0, 5.0], "series": {"x": [30.0, 40.0, 50.0]}}
    assert history.since(4.0) == {"t": [5.0], "series": {"x": [50.0]}}
    assert history.since(5.0) == {"t": [], "series": {"x": []}}


def test_what_is_missing_or_not_finite_has_no_value() -> None:
    """JSON has no NaN; a metric may begin late, or end."""
    history = History(capacity=4)
    history.add(1.0, {"x": 1.0})
    history.add(2.0, {"x": math.nan, "y": 2.0})
    history.add(3.0, {"y": math.inf})
    assert history.since(0.0)["series"] == {"x": [1.0, None, None], "y": [None, 2.0, None]}


def test_a_long_past_is_thinned_out_and_ends_with_the_present() -> None:
    history = History()
    for second in range(3700):
        history.add(float(second), {"x": float(second)})
    told = history.since(-1.0)
    assert len(told["t"]) == 720
    assert told["t"] == told["series"]["x"]
    assert (told["t"][-1], told["t"][-1] - told["t"][-2]) == (3699.0, 5.0)
    assert history.since(3000.0)["t"] == [float(second) for second in range(3001, 3700)]


def test_it_takes_gauges_and_counters_of_ours_under_the_names_of_metrics() -> None:
    registry = CollectorRegistry()
    Gauge("a2s_learner_kl", "", registry=registry).set(0.5)
    loss = Gauge("a2s_learner_loss", "", ["loss"], registry=registry)
    loss.labels(loss="q").set(2.0)
    Counter("a2s_learner_env_steps", "", registry=registry).inc(7)
    Histogram("a2s_learner_lag", "", registry=registry).observe(1.0)
    Gauge("process_open_fds", "", registry=registry).set(9)
    Info("a2s_run", "", registry=registry).info({"run": "hop", "seed": "3"})
    history = History()
    assert not history.is_up
    history.take(1.0, registry.collect())
    assert history.since(0.0)["series"] == {
        "a2s_learner_kl": [0.5],
        'a2s_learner_loss{loss="q"}': [2.0],
        "a2s_learner_env_steps_total": [7.0],
    }
    assert (history.about, history.is_up) == ({"run": "hop", "seed": "3"}, True)
